"""Known forms whose data are far apart: the step is halved until its error no longer shows in the constants."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import Trajectories, Trajectory
from gbspec.training import TrainOptions, train
from gbspec.training.recipe import step_fraction
from tests.training.conftest import model_of

ABSORPTION = """
model absorption
time t
state A
state C
learn ka = 0.3 in [0.01, 10]
learn ke = 0.1 in [0.001, 1]
A' = -ka*A
C' = ka*A - ke*C
initial A = 10
initial C = 0
observe C
"""
KA, KE = 0.82, 0.05


def absorbed(times: list[float]) -> Trajectories:
    """The exact concentrations at some times."""
    t = np.array(times)
    values = (10 * KA / (KA - KE) * (np.exp(-KE * t) - np.exp(-KA * t)))[:, None]
    item = Trajectory("1", 0.0, t, values, np.ones_like(values), np.full_like(values, np.nan), np.zeros(0))
    return Trajectories((item,), ("C",))


pytestmark = pytest.mark.usefixtures("quick_fits")
SPARSE = absorbed([0.0, 2.0, 14.0, 26.0, 38.0, 50.0])


def test_a_long_default_step_does_not_bias_a_fast_constant(tmp_path: Path) -> None:
    run = train(model_of(ABSORPTION), SPARSE, TrainOptions(workers=1, effort="low"), tmp_path / "run")
    names = [stage.name for stage in run.fit.members[0].stages]
    assert 1 <= names.count("finer step") <= 3
    assert run.fit.constants["ka"].value == pytest.approx(KA, rel=2e-3)
    assert run.fit.constants["ke"].value == pytest.approx(KE, rel=2e-4)
    assert run.member().info["max_step"] == 2.0 * 0.5 ** names.count("finer step")


def test_a_step_that_was_given_stays(tmp_path: Path) -> None:
    run = train(model_of(ABSORPTION), SPARSE, TrainOptions(workers=1, effort="low", max_step=2.0), tmp_path / "run")
    assert "finer step" not in [stage.name for stage in run.fit.members[0].stages]
    assert run.member().info["max_step"] == 2.0
    assert abs(run.fit.constants["ka"].value / KA - 1) > 0.01, "the error that the user's step has"


def test_each_finer_stage_halves_the_step() -> None:
    assert [step_fraction(["search", *["finer step"] * n]) for n in range(4)] == [1.0, 0.5, 0.25, 0.125]
