"""A stage that ends since its likelihood, or a derivative, is no finite number: what is said, and what is kept."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.operations import comparing, tables
from gbspec.report.text import run_summary
from gbspec.runs import FitRecord
from gbspec.training import TrainOptions, train
from gbspec.training.optimise import Outcome, State
from gbspec.training.population import MarginalLikelihood
from gbspec.training.population.objective import Point
from gbspec.training.runs.misjudged import _minimum
from tests.training.test_populations import model_of

pytestmark = pytest.mark.usefixtures("quick_fits")

RISE = """model rise
time t from 0
state x in [0, 20]
learn k = 0.4 in [0.01, 5]
learn s = 4 in [0.1, 20]
learn a = 0.3 in [0.01, 10]
learn b = 0.1 in [0.001, 10]
x' = k*(s - x)
initial x = 0
observe q = x noise normal(NOISE)
"""
VALUES = (0.2, 2.0, 3.3, 4.6, 4.2, 4.9, 5.3, 4.6, 5.2)


def fitted(folder: Path, noise: str, step: float | None = 0.5) -> FitRecord:
    (folder / "data.csv").write_text("t,q\n" + "".join(f"{t},{y}\n" for t, y in enumerate(VALUES)))
    model = model_of(RISE.replace("NOISE", noise), folder)
    data = tables.read_data(folder / "data.csv", model, Findings())
    return train(model, data, TrainOptions(effort="low", max_step=step), folder / "run").fit


@pytest.mark.parametrize(
    ("noise", "said"),
    [
        (
            "a + b*sqrt(y)",
            "the noise of `q` has no finite derivative by the prediction, in iteration 1 (trajectory",
        ),
        (
            "a + b/y",
            "the noise of `q` is not a finite number, in iteration 1 (trajectory `1` at t = 0, where",
        ),
    ],
)
def test_starts_are_not_reported_as_a_fit(noise: str, said: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        fit = fitted(tmp_path, noise)
        opened = gbspec.open_run(tmp_path / "run")  # also where -2 log likelihood is null in the file
        opened.report(tmp_path / "report.html")
    (told,) = [one for one in fit.warnings if "ended early" in one]
    assert said in told and "the stage `marginal likelihood` ended early" in told and "It is no fit" in told
    assert not any("was not learned" in one or "not determined" in one for one in fit.warnings)
    assert all(one.sd is None and one.interval is None for one in fit.constants.values())
    found = opened.run.fit.population
    assert found is not None and not found.maximum and found.aic is None and found.bic is None
    assert (found.minus2ll is None) == ("/" in noise)
    assert "not at its maximum: the stage that seeks it ended early" in run_summary(opened.run)
    assert "Do not rely on this fit: its likelihood is not at its maximum" in (tmp_path / "report.html").read_text()
    with pytest.raises(UserError, match="GB775"):
        comparing.compare([opened.run, opened.run])


def broken_at(stage: str, iteration: int, monkeypatch: pytest.MonkeyPatch) -> None:
    step = MarginalLikelihood.step

    def broken(self: MarginalLikelihood, state: State, at: int) -> Outcome:
        if self.name == stage and at == iteration:
            raise ComputationError("the noise of `q` is not a finite number", where="trajectory `1` at t = 3")
        return step(self, state, at)

    monkeypatch.setattr(MarginalLikelihood, "step", broken)


def test_what_was_reached_on_the_way_is_no_fit_either(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_at("marginal likelihood", 1, monkeypatch)
    fit = fitted(tmp_path, "sqrt(a^2 + (b*y)^2)")
    (told,) = [one for one in fit.warnings if "ended early" in one]
    assert "(trajectory `1` at t = 3). It is no fit" in told
    assert [one.iterations for one in fit.members[0].stages if one.name == "marginal likelihood"] == [1]
    assert fit.constants["a"].value != pytest.approx(0.3)
    assert fit.constants["k"].sd is None
    assert fit.population is not None and not fit.population.maximum


def test_a_maximum_that_a_later_stage_cannot_improve_stays_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_at("finer step", 0, monkeypatch)
    monkeypatch.setattr("gbspec.training.recipe.populations.SHOWS", -1.0)
    fit = fitted(tmp_path, "a", None)
    (told,) = [one for one in fit.warnings if "`finer step` ended early" in one]
    assert "It is no fit" not in told
    assert fit.constants["k"].sd is not None
    assert fit.population is not None and fit.population.maximum and fit.population.aic is not None


def test_a_refit_without_a_gradient_is_no_evidence() -> None:
    first = Point(np.zeros(0), np.zeros(2), 5.0, 5.0, np.zeros((1, 0)))

    def beside(y: np.ndarray, z: np.ndarray) -> Point:
        return Point(np.zeros(0), y, float(np.sum(y**2)), 0.0, z)

    _, promised = _minimum(first, beside, lambda point: np.full(2, np.nan), lambda objective, promised: False)
    assert math.isinf(promised)
