"""The conditions of a trajectory in titles: categories by name, and no digests of groups' texts."""

from __future__ import annotations

import numpy as np

from gbspec.data.trajectories import Trajectory
from gbspec.report.collect import condition_text
from tests.texts import model_of

MODEL = (
    "model m\nstate x\ncondition strain in {wild, mutant}\ncondition D\n"
    "learn k = 1 in [0.1, 9] per occ ~ lognormal\nx' = -k*D*if(strain == wild, 1, 2)*x\nobserve x\n"
)


def text(*condition: float) -> str:
    one = Trajectory("a", 0.0, np.zeros(1), np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1)), np.array(condition))
    return condition_text(model_of(MODEL), one)


def test_categories_and_groups() -> None:
    assert text(1.0, 0.5, 3.0) == "strain = mutant, D = 0.5, occ = 3"
    assert text(0.0, 0.5, 2.23e14) == "strain = wild, D = 0.5"
