"""Events in C libraries: what happens, when, and in which order, as the adaptive solver of the package has it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.data import DoseEvents, Signal
from gbspec.diagnostics import Findings
from gbspec.exports.c.verifying import errors
from gbspec.exports.checking import Course, Reference, own
from gbspec.operations import models
from tests.events.models import MIXED
from tests.exports.test_c import COMPILER, library_of, simulated_by_c
from tests.exports.texts import HAPPENING, exported, model_of

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")
SWITCHING = ("bouncing_ball", "overflowing_tanks", "thermostat")

EXACT = """model exact
time t from 0
state x in [0, 9] = 1
state n in [0, 99] = 0
input u in [0, 1] linear
x' = 0.5 - 0.1*x + 0.2*u
n' = 0
event at_two when t >= 2: x = x + 1, n = n + 1
event three at 3: x = 0.5*x, n = n + 10
event often at 0.1 every 0.1 until 0.75: n = n + 0.01
event pushed when u >= 0.75: x = 0.25*x
observe x
observe n
"""
"""Events at the times of outputs, each of which is before them, and one that an input causes within a step."""

ENDLESS = """model endless
state x in [0, 2] = 1
state n in [0, 9] = 0
x' = -1
n' = 0
event one when x <= 0.5 and n < 0.5: n = 1
event two when n > 0.5: n = 0
observe x
"""


@pytest.mark.parametrize("name", SWITCHING)
def test_bundled_models_simulate_as_the_command_does(name: str, tmp_path: Path) -> None:
    simulated_by_c(models.subject(name, {}, Findings()), tmp_path / "library", 2e-8)


@pytest.mark.parametrize("text", [HAPPENING, MIXED, EXACT])
def test_functions_and_short_courses_agree(text: str, tmp_path: Path) -> None:
    compiled = library_of(exported(model_of(text)), tmp_path)
    found = {quantity.name: quantity.error for quantity in errors(compiled, compiled.library)}
    assert found.pop("steps") < 1e-10 and found.pop("channels along steps") < 1e-10
    assert max(found.values()) < 1e-13


def followed(text: str, times: np.ndarray, folder: Path, step: float = 0.005) -> tuple[np.ndarray, np.ndarray]:
    """States by the library and by the package."""
    subject = exported(model_of(text))
    compiled = library_of(subject, folder)
    inputs = tuple(Signal(np.array([0.0, 4.0]), np.array([0.0, 1.0])) for _ in subject.model.inputs)
    doses = tuple(DoseEvents(np.array([1.55]), np.array([1.1])) for _ in subject.model.doses)
    course = Course(0.0, times, inputs, doses, step)
    points = own(subject)
    known = Reference(subject, compiled.library.programs, points).trajectory(course)[0]
    return compiled.simulate(points, course)[0], known


@pytest.mark.parametrize("text", [HAPPENING, EXACT])
def test_a_long_course(text: str, tmp_path: Path) -> None:
    """Thresholds, resets, what events cause, priorities, timed and armed events, a dose that crosses a threshold; an
    output at the time of an event is before it."""
    times = np.arange(17) * 0.25
    found, known = followed(text, times, tmp_path)
    assert np.abs(found - known).max() <= 1e-8 * np.abs(known).max()
    if text == EXACT:
        assert found[8, 1] == pytest.approx(0.07) and found[12, 1] == pytest.approx(1.07) and found[13, 1] > 11


def test_events_without_end_are_told(tmp_path: Path) -> None:
    subject = exported(model_of(ENDLESS))
    compiled = library_of(subject, tmp_path)
    points = own(subject)
    course = Course(0.0, np.array([0.2, 1.0]), (), (), 0.01)
    states, _ = compiled.simulate(points, course)
    assert np.isnan(states).all()
    states, _ = compiled.simulate(points, replace(course, times=np.array([0.2, 0.4])))
    assert states[:, 0] == pytest.approx([0.8, 0.6])
