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
from gbspec.training.recipe.stages import ChoiceOfFit
from gbspec.training.starts import refit_starts
from tests.training.conftest import model_of, trajectory

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


def test_intervals_contain_both_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ChoiceOfFit, "step", lambda self, state, iteration: Outcome(state, 1.0, True))
    whole = fitted(tmp_path / "whole").fit.constants["k"]
    monkeypatch.setattr(ChoiceOfFit, "step", keep)
    run = fitted(tmp_path / "kept")
    kept = run.fit.constants["k"]
    assert [one.name for one in run.fit.members[0].stages][-1] == "choice"
    assert kept.value != whole.value
    assert kept.interval is not None and whole.interval is not None and kept.sd is not None
    assert kept.interval[0] < whole.value < kept.interval[1]
    assert kept.sd >= abs(kept.value - whole.value)
    known = run.certainties().covariance
    assert known is not None
    of_whole = known.deviations(np.zeros((1, known.vectors.shape[1])), np.eye(1))[0]
    assert kept.sd == pytest.approx(float(np.hypot(of_whole, kept.value - whole.value)), rel=1e-3)
