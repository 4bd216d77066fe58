"""The study of published tables: its models compile, and the linear model solves what it says."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.studies import new_tables
from gbspec import frontend
from gbspec.data import Signal, Trajectories
from gbspec.data.trajectories import Trajectory
from gbspec.diagnostics import Findings


def item(label: str = "a") -> Trajectory:
    times = np.linspace(0.0, 100.0, 51)
    power = Signal(np.array([0.0, 40.0]), np.array([50.0, 10.0]))
    one = np.zeros((51, 1))
    return Trajectory(label, 0.0, times, one, np.ones((51, 1)), np.full((51, 1), np.nan), np.zeros(0), (power,), ())


@pytest.mark.parametrize("name", new_tables.PARTS)
def test_models_compile(name: str) -> None:
    assert frontend.load_model(new_tables.MODELS / f"{name}.gb", Findings()).name == name


def test_the_linear_model_is_solved_between_rows() -> None:
    a, b, c, d, e = 0.04, 0.01, 0.002, 0.05, 0.001
    found = new_tables.response(np.log([a, b, c, d, e]), item())
    heater = sensor = 0.0
    expected, step = [0.0], 2.0 / 400
    for row in range(50):
        power = 50.0 if row < 20 else 10.0
        for _ in range(400):
            heater, sensor = (
                heater + step * (a * power - b * heater + c * (sensor - heater)),
                sensor + step * (d * (heater - sensor) - e * sensor),
            )
        expected.append(sensor)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-3)


def test_trajectories_are_divided() -> None:
    data = Trajectories((item("a"), item("b")), ("x",))
    known, new = new_tables.divided(data, new_tables.Part("x", ("a",)))
    assert new is not None
    assert ([i.label for i in known.items], [i.label for i in new.items]) == (["a"], ["b"])
    assert new_tables.divided(data, new_tables.Part("x")) == (data, None)
