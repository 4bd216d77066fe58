"""A step too long for the constants that were reached is halved before whole solutions are fitted, and what is said
where they cannot be fitted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import Trajectories
from gbspec.diagnostics import ComputationError
from gbspec.report.text import run_summary
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from gbspec.training.optimise import LevenbergMarquardt, Outcome, State
from gbspec.training.recipe import step_fraction
from gbspec.training.recipe.planned import shortened
from gbspec.training.runs.ended_early import said_of_end
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

TEXT = """\
model lag "A fast lag behind an outflow that is not known"
state h in [0, 4] = 2
state s in [0, 4] = 2 "what the sensor shows"
learn k = {k} in [0.1, 40]
unknown out(h) >= 0, zero at h = 0 by mlp(3)
h' = -out(h)
s' = k*(h - s)
observe h
observe s
"""


def table() -> Trajectories:
    rng, times = np.random.default_rng(1), np.arange(0.0, 12.0, 0.5)
    h = 2 * np.exp(-0.2 * times)
    values = np.stack([h, h], axis=1) + 0.02 * rng.normal(size=(len(times), 2))
    return Trajectories((trajectory("a", 0.0, times, values, []),), ("h", "s"))


def fitted(path: Path, k: float, stages: str, step: float | None = None) -> Run:
    options = TrainOptions(
        workers=1, effort="low", solver="rk4", warm_start=False, half_step=False, stages=stages, max_step=step
    )
    return train(model_of(TEXT.format(k=k)), table(), options, path)


WHOLE = "shorter step; autoregressive"


def test_the_step_is_halved_until_whole_solutions_exist(tmp_path: Path) -> None:
    run = fitted(tmp_path / "run", 30.0, WHOLE)
    stages = run.fit.members[0].stages
    names = [stage.name for stage in stages]
    taken = names.count("shorter step")
    assert taken >= 1 and names[-1] == "autoregressive" and stages[-1].iterations
    step = 0.5 ** float(taken)
    whole = float(run.member().info["max_step"]) / step  # type: ignore[arg-type]  # a number
    assert f"largest step {whole * 0.5:.3g}, since solutions with twice this step blew up" in str(stages[1].remark)
    assert run.fit.members[0].loss is not None and "shorter step: largest step" in run_summary(run)


@pytest.mark.parametrize(("k", "step"), [(1.0, None), (30.0, 0.25)])
def test_a_stable_step_and_a_given_one_stay(tmp_path: Path, k: float, step: float | None) -> None:
    run = fitted(tmp_path / "run", k, WHOLE, step)
    assert "shorter step" not in [stage.name for stage in run.fit.members[0].stages]


def test_fractions_of_the_step() -> None:
    begun = ["teacher forcing", "half step"]
    assert step_fraction(begun) == 0.5 and shortened(begun) == 1.0
    begun += ["shorter step"]
    assert step_fraction(begun) == shortened(begun) == 0.5
    begun += ["blend", "shorter step", "autoregressive"]
    assert step_fraction(begun) == 0.25
    assert step_fraction([*begun, "finer step"]) == 0.125


def test_without_whole_solutions_constants_have_no_intervals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = LevenbergMarquardt.step
    error = ComputationError("the solution blew up", where="at t = 2", remedy="a smaller `--max-step`")

    def broken(self: LevenbergMarquardt, state: State, iteration: int) -> Outcome:
        if self.name == "autoregressive":
            raise error
        return before(self, state, iteration)

    monkeypatch.setattr(LevenbergMarquardt, "step", broken)
    run = train(
        model_of(TEXT.format(k=1)), table(), TrainOptions(workers=1, effort="low", backend="native"), tmp_path / "run"
    )
    assert "autoregressive" not in [stage.name for stage in run.fit.members[0].stages]
    assert run.fit.constants["k"].interval is None and run.fit.constants["k"].sd is None
    said = run_summary(run)
    assert "the stage `autoregressive` ended early" in said and "whole solutions were not fitted" in said
    assert "so that there are none; what may help: a smaller `--max-step`" in said
    assert "has not come to rest" not in said


def test_a_remedy_is_told_of_every_stage() -> None:
    error = ComputationError("the solution blew up", remedy="a smaller `--max-step`")
    said = said_of_end("blend", error, marginal=False, maximum=False)
    assert said.endswith("kept: the solution blew up; what may help: a smaller `--max-step`")
