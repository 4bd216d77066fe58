"""Runs of other versions: one of 0.1.0, with the module interface 1, still works; one of a newer is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.backends.module import INTERFACE
from gbspec.diagnostics import UserError
from gbspec.runs import open_run
from tests.runs.test_record import VERSION_0_1_0

pytestmark = pytest.mark.usefixtures("quick_fits", "few_points")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of a run directory that gbspec 0.1.0 wrote, beside its data."""
    shutil.copy(VERSION_0_1_0 / "data.csv", tmp_path / "data.csv")
    shutil.copytree(VERSION_0_1_0 / "run", tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "run"


def test_a_run_of_version_0_1_0_is_validated_predicted_drawn_and_reported(run: Path) -> None:
    fitted = gbspec.open_run(run)
    written = fitted.run.fit.members[0]
    found = fitted.validate("data.csv")
    assert found.channels["x"].rmse == pytest.approx(written.rmse["x"], rel=1e-6)
    assert found.step_check.half_step == pytest.approx(fitted.run.fit.step_checks[0].half_step, rel=0.1)
    predicted = fitted.predict("data.csv")
    assert len(predicted.items) == 2 and np.isfinite(predicted.items[0].mean).all()
    fitted.plot("functions", "f.png")
    fitted.report("r.html")
    assert Path("f.png").stat().st_size > 0 and "learn k" in Path("r.html").read_text()


def test_a_run_of_version_0_1_0_is_resumed_with_another_member(run: Path) -> None:
    before = open_run(run).member(0).weights
    options = {"effort": "low", "threads": 1, "workers": 1}
    resumed = gbspec.load(run / "model.gb").train("data.csv", run, members=2, resume=True, **options)  # type: ignore[arg-type]
    assert resumed.run.numbers == (0, 1)
    assert all(np.array_equal(resumed.member(0).weights[name], value) for name, value in before.items())
    assert open_run(run).fit.interface == INTERFACE
    assert f"\nINTERFACE = {INTERFACE}\n" in (run / "model.py").read_text()


@pytest.mark.parametrize("resume", [False, True])
def test_a_run_of_a_newer_interface_names_who_wrote_it_and_what_to_do(run: Path, resume: bool) -> None:
    fit = json.loads((run / "fit.json").read_text())
    newer = {"gbspec": "7.0", "model": fit["model"], "members": "elsewhere", "interface": INTERFACE + 1}
    (run / "fit.json").write_text(json.dumps(newer))
    with pytest.raises(UserError) as caught:
        if resume:
            gbspec.load(run / "model.gb").train("data.csv", run, resume=True)
        else:
            open_run(run)
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB857"
    assert f"gbspec 7.0 for the module interface {INTERFACE + 1}" in finding.message
    assert f"which reads 1 to {INTERFACE}" in finding.message
    assert finding.help is not None and "train again" in finding.help


@pytest.mark.parametrize(
    ("function", "interface", "reason"),
    [
        ("by spline(6)", 2, "coefficients of splines have other units"),
        ("increasing in x by mlp(4, 4)", 3, "second layers of networks with directions have other units"),
    ],
)
def test_weights_of_another_meaning_are_refused(tmp_path: Path, function: str, interface: int, reason: str) -> None:
    text = f"model m\ntime t\nstate x in [0, 2] = 1\nx' = -f(x)\nunknown f(x in [0, 2])\n    {function}\nobserve x\n"
    (tmp_path / "m.gb").write_text(text)
    (tmp_path / "d.csv").write_text("t,x\n" + "".join(f"{0.2 * i:.1f},{np.exp(-0.2 * i):.4f}\n" for i in range(12)))
    options = {"effort": "low", "epochs": 1, "threads": 1}
    gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "r", **options)  # type: ignore[arg-type]
    open_run(tmp_path / "r")
    fit = json.loads((tmp_path / "r" / "fit.json").read_text())
    (tmp_path / "r" / "fit.json").write_text(json.dumps(fit | {"interface": interface}))
    for resume in (False, True):
        with pytest.raises(UserError) as caught:
            if resume:
                gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "r", resume=True, **options)  # type: ignore[arg-type]
            else:
                open_run(tmp_path / "r")
        (finding,) = caught.value.diagnostics
        assert finding.code == "GB857"
        assert reason in finding.message
