"""A model with an array and events has the solutions of the same model written without the array."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from tests.events.test_kernel import the_kernel_agrees
from tests.training.conftest import model_of, problem_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

CHAIN = """model chain
state c[1..3] in [0, 8] = 1
state x in [0, 10] = 4
discrete m = 0
learn low = 2.4 in [1, 4]
learn at = 2.13 in [1, 3]
let q = 2*c[1]
let total = sum(c)
c[i]' = 0.5*(c[i-1] - c[i])
c[0] = x
x' = -0.1*x
event kick at at: x = x + c[2] + 0.1*m
event falls when c[2] >= low: x = 0.5*x, m = m + sum(c)
event lets when q + total >= 9 priority c[1]: x = 0.9*x + 0.1*total
event tells when sum(c) >= 3*low: m = m + c[3]
observe x
observe m
observe c
"""

PLAIN = """model plain
state c_1 in [0, 8] = 1
state c_2 in [0, 8] = 1
state c_3 in [0, 8] = 1
state x in [0, 10] = 4
discrete m = 0
learn low = 2.4 in [1, 4]
learn at = 2.13 in [1, 3]
let q = 2*c_1
let total = c_1 + c_2 + c_3
c_1' = 0.5*(x - c_1)
c_2' = 0.5*(c_1 - c_2)
c_3' = 0.5*(c_2 - c_3)
x' = -0.1*x
event kick at at: x = x + c_2 + 0.1*m
event falls when c_2 >= low: x = 0.5*x, m = m + total
event lets when q + total >= 9 priority c_1: x = 0.9*x + 0.1*total
event tells when total >= 3*low: m = m + c_3
observe x
observe m
observe c_1
observe c_2
observe c_3
"""

STARTED = """model started
state {states}
state x in [0, 10]
condition z in [0, 1]
x' = z - x
{balances}
initial steady with z = 0.5 then x = {second} + z
observe x
"""

START = np.array([1.0, 1.0, 1.0, 4.0, 0.0])


def test_solutions_of_the_module_and_of_the_evaluator_are_those_without_the_array() -> None:
    times = np.linspace(0.0, 8.0, 17)
    chain, plain = (load_module(model_of(text))() for text in (CHAIN, PLAIN))
    exact = Evaluator(plain).integrate(START, times)
    assert exact[-1, 4] > 3  # events have happened
    assert np.abs(Evaluator(chain).integrate(START, times) - exact).max() <= 1e-12
    stepped = plain.simulate(START, times).numpy()
    assert np.abs(chain.simulate(START, times).numpy() - stepped).max() <= 1e-12
    assert np.abs(stepped - exact).max() <= 2e-3


def test_the_kernel_agrees_with_the_graph() -> None:
    values = np.random.default_rng(1).uniform(0.5, 1.5, (10, 5))
    item = trajectory("1", 0.0, np.linspace(0.0, 6.0, 11)[1:] + 0.0137, values, [])
    data = Trajectories((item,), ("x", "m", "c_1", "c_2", "c_3"))
    the_kernel_agrees(*problem_of(model_of(CHAIN), data, 0.2))


def test_a_start_is_set_after_its_steady_state() -> None:
    chain = STARTED.format(states="c[1..2] in [0, 8]", balances="c[i]' = c[i-1] - c[i]\nc[0] = x", second="c[2]")
    plain = STARTED.format(
        states="c_1 in [0, 8]\nstate c_2 in [0, 8]", balances="c_1' = x - c_1\nc_2' = c_1 - c_2", second="c_2"
    )
    found = []
    for text in (chain, plain):
        module = load_module(model_of(text))()
        arithmetic = module.arithmetic("numpy")
        found.append(module.equations.resumed(arithmetic, np.array([0.5, 0.6, 0.7]), np.array([0.25]), ()))
        states = dict(zip(module.states, found[-1], strict=True))
        assert states == {"x": states["c_2"] + 0.25, "c_1": states["c_1"], "c_2": states["c_2"]}
    assert np.array_equal(found[0], found[1])
