"""A stage that ends since its likelihood, or a derivative, is no finite number: what is said, and what is kept."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import cast

import numpy as np
import pytest

import gbspec
from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.operations import comparing, tables
from gbspec.report.text import run_summary
from gbspec.runs import FitRecord
from gbspec.training import TrainOptions, stages, train
from gbspec.training.optimise import Outcome, State
from gbspec.training.population import MarginalLikelihood
from gbspec.training.population.held import _minimum
from gbspec.training.population.objective import Point
from gbspec.training.runs.position import Position, checkpoint, restored, write_position
from gbspec.training.stages import StageName
from tests.training.test_populations import decays, model_of

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


def fitted(folder: Path, noise: str, step: float | None = 0.5, named: str | None = None) -> FitRecord:
    (folder / "data.csv").write_text("t,q\n" + "".join(f"{t},{y}\n" for t, y in enumerate(VALUES)))
    model = model_of(RISE.replace("NOISE", noise), folder)
    data = tables.read_data(folder / "data.csv", model, Findings())
    return train(model, data, TrainOptions(effort="low", max_step=step, stages=named), folder / "run").fit


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
    assert "not at its maximum: the stage that seeks it did not run, or ended early" in run_summary(opened.run)
    assert "Do not rely on this fit: its likelihood is not at its maximum" in (tmp_path / "report.html").read_text()
    with pytest.raises(UserError, match="GB775"):
        comparing.compare([opened.run, opened.run])


def broken_at(stage: str, iteration: int, monkeypatch: pytest.MonkeyPatch) -> None:
    step = MarginalLikelihood.step

    def broken(self: MarginalLikelihood, state: State, at: int) -> Outcome:
        if self.name == stage and at == iteration:
            raise ComputationError("the noise of `q` is not a finite number", where="trajectory `1` at t = 3")
        outcome = step(self, state, at)
        return replace(outcome, done=False) if self.name == stage else outcome  # a stage may come to its end at once

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


def with_most(stage: StageName, iterations: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(cast(dict[str, tuple[int, int, int]], stages._MOST), stage, (iterations,) * 3)


def test_the_last_iteration_below_the_maximum_is_no_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_most(StageName.MARGINAL, 1, monkeypatch)
    fit = fitted(tmp_path, "sqrt(a^2 + (b*y)^2)")
    (told,) = [one for one in fit.warnings if "ended early" in one]
    assert "-2 log likelihood is still falling in iteration 1, the last one; the next step promises" in told
    assert "It is no fit" in told and "`--effort high`" in told
    assert all(one.sd is None for one in fit.constants.values())
    assert fit.population is not None and not fit.population.maximum and fit.population.aic is None


def test_the_last_iteration_may_be_at_the_maximum(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "whole").mkdir()
    whole = fitted(tmp_path / "whole", "a")
    (taken,) = [one.iterations for one in whole.members[0].stages if one.name == "marginal likelihood"]
    with_most(StageName.MARGINAL, taken - 1, monkeypatch)
    fit = fitted(tmp_path, "a")
    assert taken > 2 and fit.population is not None and fit.population.maximum
    assert fit.constants["k"].sd == pytest.approx(whole.constants["k"].sd or 0.0, rel=1e-3)


def test_a_likelihood_that_no_step_raises_is_no_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MarginalLikelihood, "_trial", lambda self, now, *given: (now, 3.2, 1e-3))
    fit = fitted(tmp_path, "sqrt(a^2 + (b*y)^2)")
    (told,) = [one for one in fit.warnings if "ended early" in one]
    assert "in iteration 1 no step lowers -2 log likelihood, although its derivatives promise a fall of" in told
    assert "It is no fit" in told and fit.population is not None and not fit.population.maximum


def test_a_maximum_that_a_later_stage_cannot_improve_stays_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_at("finer step", 0, monkeypatch)
    monkeypatch.setattr("gbspec.training.recipe.populations.SHOWS", -1.0)
    fit = fitted(tmp_path, "a", None)
    (told,) = [one for one in fit.warnings if "`finer step` ended early" in one]
    assert "It is no fit" not in told
    assert fit.constants["k"].sd is not None
    assert fit.population is not None and fit.population.maximum and fit.population.aic is not None


def test_a_stage_that_fails_on_the_way_leaves_the_maximum_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gbspec.training.recipe.populations.SHOWS", -1.0)
    (tmp_path / "whole").mkdir()
    whole = fitted(tmp_path / "whole", "a", None, "search; marginal likelihood")
    broken_at("finer step", 1, monkeypatch)
    fit = fitted(tmp_path, "a", None)
    (told,) = [one for one in fit.warnings if "ended early" in one]
    assert "the stage `finer step` ended early, and the maximum of the likelihood that was reached before" in told
    assert "finer step" not in [one.name for one in fit.members[0].stages]
    assert fit.population is not None and fit.population.maximum and fit.population.aic is not None
    assert fit.constants == whole.constants and fit.constants["k"].sd is not None


def test_a_likelihood_that_was_not_maximised_is_named(tmp_path: Path) -> None:
    fit = fitted(tmp_path, "a", named="search")
    (told,) = [one for one in fit.warnings if "not at its maximum" in one]
    assert "the stage `marginal likelihood` did not run" in told and "`--stages`" in told and "ended early" not in told
    run = gbspec.open_run(tmp_path / "run").run
    assert "not at its maximum: the stage that seeks it did not run, or ended early" in run_summary(run)
    with pytest.raises(UserError) as refused:
        comparing.compare([run, run])
    assert "did not run, or ended early" in refused.value.diagnostics[0].message


EARLY = """model early
time t from 0
state x in [0, 4]
learn k = 0.5 in [0.01, 5] per trajectory ~ lognormal
learn a = 0.1 in [1e-3, 1]
unknown f(x in [0, 4]) = 0.1*nn by mlp(2)
x' = -k*x + f(x)
initial x = 2
observe x noise normal(a)
"""


def test_what_held_out_data_chose_on_the_way_is_no_maximum(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scores = count()
    # Of several starts each takes steps before the first one is scored.
    monkeypatch.setattr(MarginalLikelihood, "_starts", lambda self, theta, others: [theta])
    monkeypatch.setattr("gbspec.training.runs.member.held_out_score", lambda *given: float(next(scores)))
    model, data = decays(tmp_path, EARLY)
    fit = train(model, data, TrainOptions(effort="low", max_step=0.5, holdout=0.4), tmp_path / "run").fit
    found = fit.population
    assert found is not None and not found.maximum and found.held
    assert found.aic is None and found.bic is None and fit.constants["a"].sd is not None
    (told,) = [one for one in fit.warnings if "chose a point on the way" in one]
    assert "Without `--holdout`" in told
    opened = gbspec.open_run(tmp_path / "run")
    assert "not at its maximum: held-out data chose a point on the way to it" in run_summary(opened.run)
    opened.report(tmp_path / "report.html")
    assert "its likelihood is not at its maximum" not in (tmp_path / "report.html").read_text()
    with pytest.raises(UserError) as refused:
        comparing.compare([opened.run, opened.run])
    assert "held-out data" in refused.value.diagnostics[0].message


@pytest.mark.parametrize(("marks", "maximum"), [((), False), (("marginal likelihood",), True)])
def test_checkpoints_without_a_word_of_maxima_have_those_of_their_stages(
    marks: tuple[str, ...], maximum: bool, tmp_path: Path
) -> None:
    vector = np.zeros(2)
    position = Position(
        theta=vector, best=vector, entry=vector, marks={"search": vector} | dict.fromkeys(marks, vector)
    )
    write_position(tmp_path, position, {}, "smooth")
    kept = checkpoint(tmp_path)
    assert kept is not None
    arrays, remarks = kept
    older = restored(arrays, replace(remarks, maximum=None, held=None, entry_ridge=None))
    assert older.maximum is maximum and (older.held is not maximum)


def test_a_refit_without_a_gradient_is_no_evidence() -> None:
    first = Point(np.zeros(0), np.zeros(2), 5.0, 5.0, np.zeros((1, 0)))

    def beside(y: np.ndarray, z: np.ndarray) -> Point:
        return Point(np.zeros(0), y, float(np.sum(y**2)), 0.0, z)

    _, promised = _minimum(first, beside, lambda point: np.full(2, np.nan), lambda objective, promised: False)
    assert math.isinf(promised)
