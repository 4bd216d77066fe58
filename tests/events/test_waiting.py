"""Events that wait: `after`, `queue`, `transient`, `sampled`, and priorities that are computed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.diagnostics import ComputationError
from tests.events.test_derivatives import some_rows, the_jacobian_is_exact
from tests.events.test_simulation import lines, module_of

DECAY = """model decay
time t from 0
state S in [0, 10]
state A in [0, 10]
discrete n = 0
learn low = 2 in [1, 3]
learn d = 1.2 in [0.1, 5]
learn k = 0.5 in [0.1, 1]
S' = -k*S
A' = S - A
initial S = 4
initial A = 1
event refill when S <= low after d + 0.1*A: S = S + 0.8*A, n = n + 1
event drain when A >= 1.5 after 0.7*d sampled queue 2: A = 0.5*A + 0.1*S
event stop when S <= 1.6 after 0.4 transient: S = S + 0.2
observe S
observe n
"""


def ends(text: str, start: list[float], times: Array) -> Array:
    """The states by the evaluator, after a comparison with the module's own steps; hidden values start at zero."""
    module = module_of(text)
    x0 = [*start, *(0.0 for _ in range(len(module.states) - len(start)))]
    found = Evaluator(module).integrate(x0, times)
    assert np.abs(module.simulate(x0, times, max_step=0.02).numpy() - found).max() < 1e-8
    return found[:, : len(start)]


def test_an_event_acts_after_its_delay() -> None:
    """It becomes true at ln 2, where x is 1, and sets x to itself and half a second later."""
    text = lines("time t from 0", "state x", "x' = -x", "event add when x <= 1 after 0.5: x = x + 3")
    found = ends(text, [2.0], np.array([0.0, math.log(2) + 0.5, 2.0]))[:, 0]
    assert np.allclose(found[1], math.exp(-0.5), atol=1e-11)
    left = (math.exp(-0.5) + 3) * math.exp(-(2.0 - math.log(2) - 0.5))
    assert np.allclose(found[2], left, atol=1e-11)


def test_sampled_values_are_those_of_the_condition() -> None:
    text = lines(
        *("time t from 0", "state x", "discrete a = 0", "discrete b = 0", "x' = 1"),
        *("event late when x >= 1 after 2: a = x", "event early when x >= 1 after 2 sampled: b = x"),
    )
    assert np.allclose(ends(text, [0.0, 0.0, 0.0], np.array([0.0, 3.5]))[-1], [3.5, 3.0, 1.0], atol=1e-10)


def test_a_transient_event_is_given_up() -> None:
    """The condition holds from 1 to 2 only."""
    text = lines(
        *("time t from 0", "state x", "discrete a = 0", "discrete b = 0", "x' = 1"),
        *("event kept when x >= 1 and x <= 2 after 1.5: a = a + 1",),
        *("event gone when x >= 1 and x <= 2 after 1.5 transient: b = b + 1",),
        *("event soon when x >= 1 and x <= 2 after 0.5 transient: b = b + 10",),
    )
    assert ends(text, [0.0, 0.0, 0.0], np.array([0.0, 4.0]))[-1, 1:].tolist() == [1.0, 10.0]


def test_several_wait_in_a_queue() -> None:
    """Every second from 1 on something enters, and comes out three seconds later."""
    statements = (
        *("time t from 0", "state x", "discrete on = 0", "discrete n = 0", "x' = 1"),
        "event go at 1 every 1: on = 1",
        "event off at 1.5 every 1: on = 0",
    )
    text = lines(*statements, "event out when on > 0.5 after 2.75 queue 3: n = n + 1")
    found = ends(text, [0.0, 0.0, 0.0], np.array([0.0, 3.7, 3.8, 4.8, 5.8, 9.8]))
    assert found[:, 2].tolist() == [0.0, 0.0, 1.0, 2.0, 3.0, 7.0]
    short = module_of(lines(*statements, "event out when on > 0.5 after 2.75 queue 2: n = n + 1"))
    start, times = [0.0] * len(short.states), np.array([0.0, 5.0])
    with pytest.raises(ComputationError, match="out_begins") as told:
        Evaluator(short).integrate(start, times)
    assert "queue" in told.value.remedy
    with pytest.raises(ArithmeticError, match="out_begins"):
        short.simulate(start, times)


def test_values_and_cancelling_at_one_time() -> None:
    """Without a delay: `sampled` sees the values before other events at that time; `transient` is cancelled by them."""
    text = lines(
        *("time t from 0", "state x", "discrete a = 0", "discrete b = 0", "discrete c = 0", "x' = 1"),
        "event first when x >= 1 and a < 0.5 priority 3: a = 1",
        "event seen when x >= 1 sampled: b = a + 10",
        "event cancelled when x >= 1 and a < 0.5 transient: c = 1",
    )
    assert ends(text, [0.0, 0.0, 0.0, 0.0], np.array([0.0, 2.0]))[-1, 1:].tolist() == [1.0, 10.0, 0.0]


@pytest.mark.parametrize(("order", "last"), [("x", 2.0), ("2 - x", 1.0)])
def test_a_priority_can_be_computed(order: str, last: float) -> None:
    """Both happen at x = 1.5; the second has the priority 1."""
    text = lines(
        *("time t from 0", "state x", "discrete a = 0", "x' = 1"),
        *(f"event one when x >= 1.5 priority {order}: a = 1", "event two when x >= 1.5 priority 1: a = 2"),
    )
    assert ends(text, [0.0, 0.0], np.array([0.0, 2.0]))[-1, 1] == last


def test_an_armed_event_waits_from_the_start() -> None:
    text = lines("time t from 0", "state x", "discrete a = 0", "x' = 1", "event go when x >= 0 after 1 armed: a = 1")
    assert ends(text, [0.0, 0.0], np.array([0.0, 0.9, 1.1]))[:, 1].tolist() == [0.0, 0.0, 1.0]


def test_the_derivatives_of_delayed_times_are_exact() -> None:
    the_jacobian_is_exact(DECAY, some_rows(2, 10, 6.0), 0.25, 0.0)
