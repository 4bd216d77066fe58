"""What a profile says of better fits than the run's, and of bounds of other constants."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import Trajectories
from gbspec.training import TrainOptions, train
from gbspec.training.profile import said
from gbspec.training.profile.likelihood import profile_constant
from gbspec.training.profile.result import ProfilePoint
from gbspec.training.profile.said import said_of_better, said_of_bounds, said_of_estimate
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

MODEL = model_of(
    "model m\nstate x in [0, 10] = 1\nlearn tau = 1 in [0.1, 10]\nlearn amp = 50 in [0, 100]\n"
    "x' = amp - x/tau\nobserve x\n"
)


def point(value: float, deviance: float, amp: float = 50.0) -> ProfilePoint:
    return ProfilePoint(value, deviance, {"amp": amp}, True)


def test_a_better_fit_than_the_run_is_told_with_its_values() -> None:
    assert said_of_better("tau", point(1.0, 0.3), point(1.1, 0.0)) == []
    (text,) = said_of_better("tau", point(1.0, 11.3), point(2.5, 0.0, 70.0))
    assert "the run's fit (refitted: tau = 1) is not the best one" in text and "lower by 11.3" in text
    assert "`tau = 2.5`, `amp = 70`" in text


def test_an_estimate_that_is_not_the_runs_is_told_with_its_criterion() -> None:
    assert said_of_estimate("tau", 1.0, 1.01, 0.05, functions=True) == []
    (text,) = said_of_estimate("tau", 1.0, 1.2, 0.6, functions=True)
    assert "tau = 1.2, is not that of the fit, 1:" in text and "least squares of whole solutions" in text
    assert "near those of the run" in text
    assert "functions" not in said_of_estimate("tau", 1.0, 1.2, 0.6, functions=False)[0]


def test_a_profile_compares_its_estimate_with_the_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.arange(0.0, 5.0, 0.5)
    values = (2.0 - np.exp(-times) + 0.01 * np.random.default_rng(0).normal(size=len(times)))[:, None]
    data = Trajectories((trajectory("1", 0.0, times, values, []),), ("x",))
    run = train(MODEL, data, TrainOptions(workers=1, effort="low", max_step=0.1), tmp_path / "run")
    assert not [note for note in profile_constant(run, "tau", data, points=1).notes if "not that of the fit" in note]
    monkeypatch.setattr(said, "NOTICED", -1.0)
    first, *_ = profile_constant(run, "tau", data, points=1).notes
    assert f"is not that of the fit, {run.fit.constants['tau'].value:.4g}: " in first


def test_another_constant_at_its_bound_is_named_where_the_profile_meets_it() -> None:
    side = (point(1.2, 0.5, 90.0), point(1.6, 78.0, 100.0), point(2.0, 300.0, 100.0))
    (text,) = said_of_bounds(MODEL, "tau", {"amp": 60.0}, side)
    assert "at tau = 1.6" in text and "`amp` at its bound 100" in text
    assert said_of_bounds(MODEL, "tau", {"amp": 60.0}, side[:1]) == []
    assert said_of_bounds(MODEL, "tau", {"amp": 100.0}, side) == [], "it is there at the estimate already"
