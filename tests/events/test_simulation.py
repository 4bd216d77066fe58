"""Solutions with events: of the evaluator and of the generated module, against formulas and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.casadi.events import _Trajectory
from gbspec.backends.module import load_module
from gbspec.data.trajectories import DoseEvents, Signal
from gbspec.diagnostics import ComputationError
from tests.events.models import BALL, THERMOSTAT
from tests.training.conftest import model_of

ENDLESS = """model endless
state x
discrete n = 0
x' = 1
event go at 1: n = 1
event down when n >= 1: n = 0
event up when n <= 0: n = 1
observe x
"""


def module_of(text: str, **constants: float) -> GeneratedModule:
    made = load_module(model_of(text))()
    values = dict(zip(made.constants, made.weights["constants"], strict=True)) | constants
    made.weights["constants"] = np.array([values[name] for name in made.constants])
    return type(made)(made.weights)


def heights(times: Array, e: float, g: float, height: float = 5.0) -> Array:
    """The height of a ball that is dropped."""
    found = []
    for time in times:
        at = math.sqrt(2 * height / g)
        if time <= at:
            found.append(height - g * time**2 / 2)
            continue
        speed = e * g * at
        while time > at + 2 * speed / g:
            at, speed = at + 2 * speed / g, speed * e
        found.append(speed * (time - at) - g * (time - at) ** 2 / 2)
    return np.array(found)


def test_a_bouncing_ball() -> None:
    module, times = module_of(BALL, e=0.8, g=9.81), np.linspace(0.0, 4.0, 21)
    exact = heights(times, 0.8, 9.81)
    found = Evaluator(module).integrate([5.0, 0.0, 0.0], times)
    assert np.abs(found[:, 0] - exact).max() < 1e-11
    stepped = module.simulate([5.0, 0.0, 0.0], times).numpy()
    assert np.abs(stepped[:, 0] - exact).max() < 1e-11
    assert np.array_equal(stepped[:, 2], found[:, 2])


def test_a_thermostat_as_by_scipy() -> None:
    module = module_of(THERMOSTAT, low=18.0, high=22.0, k=0.25)
    times = np.linspace(0.0, 9.0, 19)

    def rate(t: float, x: Array, on: float) -> Array:
        return 0.25 * (8 - x) + 6 * on

    def reached(t: float, x: Array, on: float) -> float:
        return float(x[0]) - (22.0 if on else 18.0)

    reached.terminal = True  # type: ignore[attr-defined]
    expected, at, x, on = np.full(len(times), 15.0), 0.0, np.array([15.0]), 1.0
    while at < times[-1]:
        options = {"rtol": 1e-13, "atol": 1e-13, "dense_output": True, "method": "DOP853"}
        part = solve_ivp(rate, (at, times[-1] + 1e-9), x, args=(on,), events=reached, **options)
        inside = (times > at) & (times <= part.t[-1])
        expected[inside] = part.sol(times[inside])[0]
        at, x, on = part.t[-1], part.y[:, -1], 1.0 - on
    found = Evaluator(module).integrate([15.0, 1.0], times)
    assert np.abs(found[:, 0] - expected).max() < 1e-10
    stepped = module.simulate([15.0, 1.0], times, max_step=0.05)
    assert np.abs(stepped[:, 0].numpy() - expected).max() < 1e-8


def lines(*statements: str) -> str:
    """A model that observes x."""
    return "\n".join(["model small", *statements, "observe x"])


def both(text: str, x0: list[float], times: Array) -> Array:
    """The states by the evaluator, after a comparison with the module's own steps."""
    module = module_of(text)
    found = Evaluator(module).integrate(x0, times)
    assert np.abs(module.simulate(x0, times, max_step=0.5).numpy() - found).max() < 1e-8
    return found


def test_order_at_one_time_and_cascades() -> None:
    """Timed before state events, then by priority, then as written; right sides see the values before."""
    text = """model order
    state x
    discrete a = 1
    discrete b = 0
    discrete told = 0
    x' = 1
    event third when x >= 2: told = 10*told + 3
    event second when x >= 2 priority 1: told = 10*told + 2
    event first at 2: told = 10*told + 1
    event swap when x >= 3: a = b, b = a
    event caused when b >= 1: told = 10*told + 4
    event once at 3.5 every 0.25 until 4.01: told = told + 1000
    observe x""".replace("\n    ", "\n")
    found = both(text, [0.0, 1.0, 0.0, 0.0], np.array([0.0, 1.9, 2.5, 3.2, 5.0]))
    assert found[:, 3].tolist() == [0.0, 0.0, 123.0, 1234.0, 4234.0]
    assert found[3, 1:3].tolist() == [0.0, 1.0]


def test_a_measured_value_is_that_before_an_event() -> None:
    text = lines("time t from 0", "state x", "x' = 1", "event down at 1: x = 0", "event back when x >= 0.5: x = 0.1")
    found = both(text, [0.0], np.array([0.0, 0.5, 0.9, 1.0, 1.25]))
    assert np.allclose(found[:, 0], [0.0, 0.5, 0.5, 0.2, 0.25], rtol=0, atol=1e-12)


def test_armed() -> None:
    text = lines(
        *("state x", "discrete n = 0", "discrete m = 0", "x' = 1"),
        *("event a when x >= 0 armed: n = 1", "event b when x >= 0: m = 1"),
    )
    assert both(text, [1.0, 0.0, 0.0], np.array([0.0, 1.0]))[-1, 1:].tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("condition", "at"),
    [
        ("if(t >= 3, 1, -1) > 0", 3.0),
        ("not (if(t >= 3, 1, -1) < 0)", 3.0),
        ("sign(t - 3) >= 0", 3.0),
        ("if(x < 0.5, if(t > 2, 1, 0), 0) > 0.5", 5.0),
        ("jumping > 0.5", 3.0),
        ("if(t > 3, x, 1 - x) > 0.6", 3.0),
        ("if(n >= 1, 0, x) < 0.4", 6.0),
        ("if(x < 0.25, 1, if(x > 0.75, 1, 0)) == 1", 7.5),
    ],
)
def test_conditions_whose_sides_jump(condition: str, at: float) -> None:
    """Once, at the time of the jump, also where a measurement is made then."""
    text = lines(
        *("time t from 0", "state x", "discrete n = 0", "discrete told = 0", "let jumping = if(t < 3, x - 1, x)"),
        *("x' = -0.1", f"event e when {condition}: n = n + 1, told = t"),
    )
    found = both(text, [1.0, 0.0, 0.0], np.arange(0.0, 10.5, 0.5))
    assert found[-1, 1:].tolist() == [1.0, pytest.approx(at, abs=1e-9)]


def test_a_maximum_within_a_step_and_inputs() -> None:
    """A threshold that is crossed twice within a step, and one that a jump of an input crosses."""
    text = lines(
        *("state x", "discrete n = 0", "input u held", "x' = cos(t)"),
        *("event up when x >= 0.99: n = n + 1", "event jump when u > 2: n = n + 10"),
    )
    module, times = module_of(text), np.array([0.0, 1.0, 2.0, 3.0])
    signal = Signal(np.array([0.0, 2.0]), np.array([1.0, 3.0]))
    found = Evaluator(module).integrate([0.0, 0.0], times, inputs=(signal,))
    assert found[:, 1].tolist() == [0.0, 0.0, 1.0, 11.0]
    stepped = module.simulate([0.0, 0.0], times, inputs=[[1.0], [1.0], [3.0], [3.0]])
    assert stepped[:, 1].tolist() == [0.0, 0.0, 1.0, 11.0]


def test_a_dose_makes_a_condition_true() -> None:
    text = lines("state x", "discrete n = 0", "x' = -x", "dose x", "event up when x >= 1: n = n + 1")
    doses = DoseEvents(np.array([0.5, 0.6, 3.0]), np.array([2.0, 2.0, 2.0]))
    found = Evaluator(module_of(text)).integrate([0.0, 0.0], np.array([0.0, 0.5, 2.0, 4.0]), doses=(doses,))
    assert found[:, 1].tolist() == [0.0, 0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("text", "x0", "said"),
    [
        (BALL, [0.01, 0.0, 0.0], "ever shorter intervals"),
        (ENDLESS, [0.0, 0.0], "more than 100 events"),
    ],
)
def test_events_without_end_are_told(text: str, x0: list[float], said: str) -> None:
    module = module_of(text)
    with pytest.raises(ComputationError, match=said):
        Evaluator(module).integrate(x0, np.array([0.0, 2.0]))
    with pytest.raises(ArithmeticError, match=said):
        module.simulate(x0, [0.0, 2.0])


def test_a_batch_has_events_at_its_own_times() -> None:
    module, times = module_of(BALL), np.linspace(0.0, 2.5, 6)
    e = torch.tensor([0.8, 0.9])
    found = module.simulate([[5.0, 0.0, 0.0], [3.0, 0.0, 0.0]], times, constants={"e": e, "g": 9.81})
    for row, (restitution, height) in enumerate([(0.8, 5.0), (0.9, 3.0)]):
        assert np.abs(found[row, :, 0].numpy() - heights(times, restitution, 9.81, height)).max() < 1e-6


def test_no_evaluation_lies_behind_a_jump_of_the_right_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """One at the end of a step would look like an error of the method, which takes ever shorter steps then."""
    text = "model m\ntime t from 0\nstate x\nevent half at 3.3: x = x/2\nx' = {} - x\nobserve x\n"
    evaluations, rate = [0], _Trajectory.rate

    def counted(self: _Trajectory, time: float, state: Array) -> Array:
        evaluations[0] += 1
        return rate(self, time, state)

    monkeypatch.setattr(_Trajectory, "rate", counted)
    times, numbers = np.arange(0.0, 12.1, 0.5), []
    for right in ("if(mod(t, 6) < 2.5, 1, 0)", "0"):
        evaluations[0] = 0
        found = Evaluator(module_of(text.format(right))).integrate([1.0], times)[:, 0]
        numbers.append(evaluations[0])
        wanted, x, before = [], 1.0, 0.0
        for time in sorted({*times, 2.5, 3.3, 8.5}):
            level = 1.0 if right != "0" and (0.5 * (time + before)) % 6 < 2.5 else 0.0
            x, before = level + (x - level) * math.exp(before - time), time
            wanted += [x] if time in times else []
            x = x / 2 if time == 3.3 else x
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-11)
    assert numbers[0] < 4 * numbers[1]
