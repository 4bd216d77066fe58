"""Where the fit of intervals is kept, constants have intervals of whole solutions that contain both fits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import Trajectories
from gbspec.data.trajectories import Signal
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from gbspec.training.optimise import Outcome, State
from gbspec.training.problem import Bijections
from gbspec.training.recipe.stages import ChoiceOfFit
from gbspec.training.starts import refit_starts
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

TEXT = """\
model tank "An outflow that is not known, and a leak"
input u held
state h in [0, 4] = 1
learn k = 0.2 in [0.01, 2]
unknown out(h) >= 0, zero at h = 0, increasing in h by mlp(4)
h' = k*u - out(h)
observe h
"""


def table() -> Trajectories:
    """A tank with disturbances between its 80 rows, and little noise."""
    rng, h, values, steps = np.random.default_rng(2), 1.0, [], 20
    times = np.linspace(0.0, 40.0, 81)
    force = np.repeat(rng.uniform(0.5, 2.0, 9), 10)[:81]
    for u in force:
        values.append(h + 0.005 * rng.normal())
        for _ in range(steps):
            h += 0.5 / steps * (0.4 * u - 0.35 * np.sqrt(max(h, 0))) + 0.06 * np.sqrt(0.5 / steps) * rng.normal()
    one = trajectory("a", 0.0, times, np.array(values)[:, None], [], inputs=(Signal(times, np.asarray(force)),))
    return Trajectories((one,), ("h",))


def keep(self: ChoiceOfFit, state: State, iteration: int) -> Outcome:
    """Keeps the fit of intervals."""
    return Outcome({"theta": refit_starts(self.free, self.earlier, self.seed)}, 1.0, True, "kept")


def fitted(path: Path) -> Run:
    return train(model_of(TEXT), table(), TrainOptions(workers=1, effort="low"), path)


def leave(self: ChoiceOfFit, state: State, iteration: int) -> Outcome:
    """Keeps the fit of whole solutions."""
    return Outcome(state, 1.0, True)


def of_covariance(run: Run) -> float:
    """The standard deviation of the constant that predictions have."""
    known = run.certainties().covariance
    assert known is not None
    return float(known.deviations(np.zeros((1, known.vectors.shape[1])), np.eye(1))[0])


def test_intervals_contain_both_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ChoiceOfFit, "step", leave)
    whole = fitted(tmp_path / "whole").fit.constants["k"]
    monkeypatch.setattr(ChoiceOfFit, "step", keep)
    run = fitted(tmp_path / "kept")
    kept = run.fit.constants["k"]
    assert [one.name for one in run.fit.members[0].stages][-1] == "choice"
    assert kept.interval is not None and whole.interval is not None and kept.sd is not None
    assert kept.interval[0] < whole.value < kept.interval[1]
    maps = Bijections.of((run.model.learnables[0],))
    at, other = (maps.from_natural(np.array([one.value])) for one in (kept, whole))
    apart = float((maps.derivative(at) * (other - at))[0])
    assert abs(apart) > 1e-4
    assert kept.sd == pytest.approx(float(np.hypot(of_covariance(run), apart)), rel=1e-3)


def test_a_fit_of_whole_solutions_that_went_astray_is_no_second_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kept one follows whole solutions more closely: what separates them is the error of the other one."""

    def after_a_bad_end(self: ChoiceOfFit, state: State, iteration: int) -> Outcome:
        state["theta"][...] += 1.0  # the mark of the stage before is this array
        return keep(self, state, iteration)

    monkeypatch.setattr(ChoiceOfFit, "step", after_a_bad_end)
    run = fitted(tmp_path / "kept")
    assert run.fit.constants["k"].sd == pytest.approx(of_covariance(run), rel=1e-3)


def test_the_loss_that_is_told_is_that_of_the_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that become finer after the choice change it."""

    def worse(self: ChoiceOfFit, state: State, iteration: int) -> Outcome:
        kept = keep(self, state, iteration).state["theta"]
        kept[: self.free.parameters.n_weights] *= 0.5
        return Outcome({"theta": kept}, 1.0, True, "kept")

    monkeypatch.setattr(ChoiceOfFit, "step", worse)
    run = fitted(tmp_path / "kept")
    (loss,) = [one.loss for one in run.fit.members]
    assert [w for w in run.fit.warnings if f"the fit of intervals, which was kept, have the loss {loss:.3g};" in w]
