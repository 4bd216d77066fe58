"""Rows of constants are learned like single ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data.trajectories import Trajectories
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAYS = "model m\ntime t from 0\nstate c[1..3] in [0, 2]\nlearn k[1..3] = 1 in [0, 9]\n"
DECAYS += "c[i]' = -k[i]*c[i]\ninitial c = 1\nobserve c\n"


def test_each_constant_of_a_row_is_found(tmp_path: Path) -> None:
    times, rates = np.linspace(0.1, 2, 12), np.array([0.4, 1.5, 3.0])
    data = Trajectories((trajectory("1", 0.0, times, np.exp(-times[:, None] * rates), []),), ("c_1", "c_2", "c_3"))
    fit = train(model_of(DECAYS), data, TrainOptions(effort="low", max_step=0.05), tmp_path / "run").fit
    found = [fit.constants[f"k_{i}"].value for i in (1, 2, 3)]
    assert found == pytest.approx(rates, rel=1e-5)
