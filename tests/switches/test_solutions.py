"""Steps that end where right-hand sides switch: their order, derivatives, and the kernel's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.data.trajectories import Signal, Trajectories
from gbspec.ir import METHODS, Model
from gbspec.passes import with_switches
from gbspec.training.engines.counting import happened
from gbspec.training.engines.objective import linearise, residual_table
from gbspec.training.problem import Control, measured_only
from tests.events.test_derivatives import some_rows
from tests.events.test_kernel import engines_of, the_kernel_agrees
from tests.switches.models import FRICTION, ORDER, OVERFLOW, RELAY, SEVERAL
from tests.training.conftest import model_of, problem_of, trajectory
from tests.training.reference import whole_jacobian

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.usefixtures("quick_fits")


def cut(text: str) -> Model:
    found = with_switches(model_of(text))
    assert found.model is not None, found.reason
    return found.model


def with_input() -> Trajectories:
    items = []
    for i in range(2):
        times = np.linspace(0.0, 1.8, 5)
        signal = Signal(np.array([0.0, 1.1, 2.0, 3.0]), np.array([0.2, 0.9 + 0.1 * i, 0.1, 1.2]))
        values = np.random.default_rng(i).uniform(0.3, 1.5, (5, 2))
        items.append(trajectory(str(i), 0.0, times, values, [], inputs=(signal,)))
    return Trajectories(tuple(items), ("a", "total"))


ROWS = {OVERFLOW: some_rows(1, 6, 4.0), ORDER: some_rows(1, 6, 4.0), RELAY: some_rows(1, 6, 4.0), SEVERAL: with_input()}


def values(model: Model, data: Trajectories, step: float) -> Array:
    problem, parameters, theta = problem_of(model, data, step, blend=0.0)
    return residual_table(engines_of(problem, parameters)[1], theta)


@pytest.mark.parametrize("text", [OVERFLOW, RELAY, SEVERAL], ids=["overflow", "relay", "several"])
def test_the_order_of_the_method_is_restored(text: str) -> None:
    """Halving the step divides errors by 2 to the fourth where steps end at the switches, and by far less elsewhere."""
    model, data = model_of(text), ROWS[text]
    exact = values(cut(text), data, 0.0125)
    errors = [[np.abs(values(each, data, step) - exact).max() for step in (0.1, 0.025)] for each in (cut(text), model)]
    (coarse, fine), (as_before, still) = errors
    assert 8.0 < np.sqrt(coarse / fine) < 40.0
    assert np.sqrt(as_before / still) < 7.0 and as_before > 5 * coarse


CASES = pytest.mark.parametrize(
    ("text", "blend"), [(OVERFLOW, 0.0), (ORDER, 0.0), (RELAY, 0.0), (SEVERAL, 0.0), (SEVERAL, 1.0)]
)


@CASES
def test_the_jacobian_is_exact(text: str, blend: float) -> None:
    """Differences of order four; the threshold of a jump moves solutions by the time of the switch alone."""
    problem, parameters, theta = problem_of(cut(text), ROWS[text], 0.14, blend=blend)
    kernel, h = engines_of(problem, parameters)[1], 1e-5
    direction = np.random.default_rng(5).standard_normal(len(theta))
    table = [residual_table(kernel, theta + s * h * direction) for s in (2, 1, -1, -2)]
    expected = measured_only(problem, (8 * (table[1] - table[2]) - (table[0] - table[3])) / (12 * h))
    found = whole_jacobian(linearise(kernel, theta), parameters).numpy() @ direction
    assert np.abs(expected - found).max() < 1e-7 * np.abs(found).max()


@CASES
def test_the_kernel_agrees_with_the_graph(text: str, blend: float) -> None:
    the_kernel_agrees(*problem_of(cut(text), ROWS[text], 0.15, blend=blend))


@pytest.mark.parametrize("solver", ["dopri5", "ros34pw2"])
@pytest.mark.parametrize("text", [OVERFLOW, RELAY, SEVERAL], ids=["overflow", "relay", "several"])
def test_adaptive_steps_end_at_switches_too(text: str, solver: str) -> None:
    """With the derivatives of exact solutions, through the times of jumps; those of the graph are the kernel's."""
    model = cut(text)
    problem, parameters, theta = problem_of(model, ROWS[text], np.inf, blend=0.0, method=METHODS[solver])
    fixed, same, _ = problem_of(model, ROWS[text], 0.01, blend=0.0)
    exact = linearise(engines_of(fixed, same)[1], theta).shared
    problem = replace(problem, control=Control(1e-6, np.ones(len(model.states))))
    found = linearise(engines_of(problem, parameters)[1], theta).shared
    assert float((exact - found).abs().max()) < 1e-4 * float(exact.abs().max())
    problem = replace(problem, control=Control(1e-3, np.ones(len(model.states))))
    graph, kernel = (linearise(engine, theta).shared for engine in engines_of(problem, parameters))
    assert float((graph - kernel).abs().max()) < 1e-4 * float(kernel.abs().max())


def test_a_solution_that_slides_is_taken_as_without_switches() -> None:
    problem, parameters, theta = problem_of(cut(FRICTION), some_rows(1, 5, 12.0), 0.1, blend=0.0)
    plain = problem_of(model_of(FRICTION), some_rows(1, 5, 12.0), 0.1, blend=0.0)
    kernel, other = engines_of(problem, parameters)[1], engines_of(*plain[:2])[1]
    found, before = residual_table(kernel, theta), residual_table(other, theta)
    assert np.isfinite(found).all() and np.abs(found - before).max() < 0.3
    counts = happened(kernel, theta)
    assert counts is not None and counts.uncut.sum() > 10
    the_kernel_agrees(problem, parameters, theta)
