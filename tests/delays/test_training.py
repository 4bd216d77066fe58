"""Fits of models with delays, from tables to predictions."""

from __future__ import annotations

from pathlib import Path

import pytest

import gbspec
from gbspec.data import MetricsOptions
from gbspec.diagnostics import UserError
from gbspec.frontend import load_model
from gbspec.training.options import Backend
from tests import quick
from tests.delays.models import MACKEY_GLASS

UNKNOWN = """model released
time t from 0
state P in [0, 2]
learn tau = 4 in [2, 8]
unknown production(P) by mlp(4)
P' = production(delay(P, tau)) - 0.2*P
history P = 0.4
observe P
truth tau = 5
truth production = 0.4*P/(1 + P^4)
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "model.gb"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.usefixtures("quick_fit")
@pytest.mark.parametrize("backend", ["torch", "native"])
def test_a_delay_is_recovered_from_data_without_noise(tmp_path: Path, backend: Backend) -> None:
    specification = gbspec.load(written(tmp_path, MACKEY_GLASS))
    data = specification.simulate(trajectories=1, span=45, dt=3, sampling="regular")
    run = specification.train(data, tmp_path / "run", stages="least squares", max_step=1.0, backend=backend)
    assert run.constants["tau"] == pytest.approx(17.0, rel=1e-4)
    assert run.constants["beta"] == pytest.approx(0.2, rel=1e-3)


def test_a_network_behind_a_delay_is_trained_and_predicts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    specification = gbspec.load(written(tmp_path, UNKNOWN))
    data = specification.simulate(trajectories=1, span=8, dt=1, sampling="regular")
    with quick.warm_start(30):
        run = specification.train(data, tmp_path / "run", stages="teacher forcing", max_step=1.0, effort="low")
    assert 2 < run.constants["tau"] < 8
    few = MetricsOptions(conditions=2, points=2, rhs_points=4)
    monkeypatch.setattr("gbspec.analysis.validation.validate._few", lambda: few)
    found = run.validate(data)
    assert found.channels["P"].rmse < 0.5
    assert found.step_check.half_step is not None
    assert run.eigen(at=[{"P": 0.7}]).points[0].eigenvalues.shape == (9,), "eight roots, and the other one of a pair"


def test_what_is_not_offered_is_refused(tmp_path: Path) -> None:
    specification = gbspec.load(written(tmp_path, MACKEY_GLASS))
    data = specification.simulate(trajectories=1, span=20, dt=5)
    with pytest.raises(UserError, match="GB768"):
        specification.train(data, tmp_path / "run", solver="ros34pw2")
    with pytest.raises(UserError, match="GB808"):
        specification.export(tmp_path / "model.xml", "sbml")


def test_a_name_of_the_model_keeps_its_meaning(tmp_path: Path) -> None:
    from gbspec.diagnostics import Findings

    text = "model m\nstate delay\nstate history\nunknown f(delay)\ndelay' = -f\nhistory' = -history\nobserve delay"
    assert not load_model(written(tmp_path, text), Findings()).delays
    called = "model m\nstate x\nunknown delay(x)\nx' = -delay(x)\nobserve x"
    assert not load_model(written(tmp_path, called), Findings()).delays


def test_the_editor_explains_delay_unless_the_model_declares_it(tmp_path: Path) -> None:
    from gbspec.lsp.hover import hover
    from gbspec.lsp.workspace import Workspace

    for text, expected in (
        (MACKEY_GLASS, "delay(X, tau)"),
        ("model m\nstate x\nunknown delay(x)\nx' = delay(x)", "x)"),
    ):
        path = written(tmp_path, text)
        found = hover(Workspace(roots=(tmp_path,)), path, text.rindex("delay("), {})
        assert found is not None and expected in found.markdown
