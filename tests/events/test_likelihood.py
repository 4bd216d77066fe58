"""`evaluate` with events: the predictions are those of the evaluator, though an event changes the speed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.backends.casadi.evaluator import Evaluator
from tests.events.test_simulation import module_of

SWITCHED = """model switched
time t from 0
state y
discrete k = 0.4
learn fast = 1.8 in [0, 5]
y' = -k*y
initial y = 1
event go when t >= 2: k = fast, y = y + 1
observe y noise normal(0.1)
"""


def test_steps_are_short_enough_after_an_event(tmp_path: Path) -> None:
    (tmp_path / "model.gb").write_text(SWITCHED)
    (tmp_path / "data.csv").write_text("t,y\n1,0.6\n2,0.5\n3,0.3\n")
    found = gbspec.evaluate(tmp_path / "model.gb", tmp_path / "data.csv")
    expected = Evaluator(module_of(SWITCHED)).integrate([1.0, 0.4], np.array([0.0, 1.0, 2.0, 3.0]))[1:, 0]
    assert [one.value for one in found.found.simulation] == pytest.approx(expected.tolist(), rel=1e-7)
    slope = 100 * (expected[2] - 0.3) * -expected[2]
    assert found.gradient["fast"] == pytest.approx(slope, rel=1e-6)
    assert found.accuracy < 1e-7
