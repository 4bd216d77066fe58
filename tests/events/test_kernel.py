"""The native kernel has the same events as the torch graph: values, gradients and Jacobians agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.data.trajectories import Trajectories
from gbspec.ir import METHODS
from gbspec.training.engines.engine import Engine, Unable
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.kernel import Kernel, kernel_of
from gbspec.training.engines.objective import linearise, residual_table
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.events.models import BALL, MIXED, THERMOSTAT
from tests.events.test_derivatives import mixed_rows, some_rows
from tests.events.test_waiting import DECAY
from tests.training.conftest import model_of, problem_of, trajectory

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.usefixtures("quick_fits")

RANKED = """model ranked
time t from 0
state x in [0, 5]
discrete told = 1
learn p = 0.4 in [0.1, 2]
learn limit = 1.1 in [0.5, 3]
x' = 0.7 + 0.1*sin(told)
event one when x >= limit priority p: x = 0.5*x, told = 0.6*told + p
event two when x >= limit priority 1.1 - p: x = x - 0.2*p, told = told + 0.1*x
event tick at p every limit: told = 0.5*told + p*t
observe x
observe told
"""


def engines_of(problem: Problem, parameters: Parameters) -> tuple[Engine, Engine]:
    """The torch graph, and the kernel."""
    kernel = kernel_of(problem.model, type(problem.module))
    assert isinstance(kernel, Kernel), kernel
    return TorchEngine(problem, parameters), NativeEngine(problem, parameters, kernel)


def the_kernel_agrees(problem: Problem, parameters: Parameters, theta: Array) -> None:
    graph, kernel = engines_of(problem, parameters)
    tables = [residual_table(engine, theta) for engine in (graph, kernel)]
    assert np.isfinite(tables[0]).all()
    assert np.abs(tables[1] - tables[0]).max() <= 1e-10 * max(1.0, np.abs(tables[0]).max())
    (value, gradient), (own, found) = (engine.half_squares(theta, engine.plan(theta)) for engine in (graph, kernel))
    assert abs(own - value) <= 1e-10 * value
    assert np.abs(found - gradient).max() <= 1e-9 * np.abs(gradient).max()
    whole, ours = (linearise(engine, theta) for engine in (graph, kernel))
    for of_graph, of_kernel in ((whole.shared, ours.shared), (whole.local, ours.local)):
        if of_graph.numel():
            assert float((of_graph - of_kernel).abs().max()) <= 1e-9 * float(of_graph.abs().max())


@pytest.mark.parametrize(("text", "data", "step", "blend"), [
    (BALL, some_rows(2, 10, 3.0), 0.15, 0.0),
    (THERMOSTAT, some_rows(1, 10, 8.0), 0.4, 0.0),
    (MIXED, mixed_rows(), 0.2, 0.0),
    (MIXED, mixed_rows(), 0.2, 1.0),
    (DECAY, some_rows(2, 8, 6.0), 0.2, 0.0),
    (RANKED, some_rows(2, 8, 4.0), 0.25, 0.0),
], ids=["ball", "thermostat", "mixed", "forced", "waiting", "ranked"])  # fmt: skip
def test_values_and_derivatives_agree_with_the_graph(text: str, data: Trajectories, step: float, blend: float) -> None:
    the_kernel_agrees(*problem_of(model_of(text), data, step, blend=blend))


def test_another_method() -> None:
    the_kernel_agrees(*problem_of(model_of(BALL), some_rows(2, 6, 3.0), 0.3, method=METHODS["dopri5"]))


def test_single_precision_is_left_to_the_graph() -> None:
    problem, _, _ = problem_of(model_of(BALL), some_rows(2, 3, 1.0), 0.3)
    found = kernel_of(problem.model, type(problem.module), "float32")
    assert isinstance(found, Unable) and "double precision" in found.reason


def test_an_unknown_function_in_a_condition_is_left_to_the_graph() -> None:
    text = BALL.replace("h <= 0 and v < 0", "h <= f and v < 0").replace("h' = v", "unknown f(h) by mlp(4)\nh' = v")
    problem, _, _ = problem_of(model_of(text), some_rows(2, 3, 1.0), 0.3)
    found = kernel_of(problem.model, type(problem.module))
    assert isinstance(found, Unable) and "an unknown function stands in the condition of an event" in found.reason


DROPPED = BALL.replace("initial h = 5", "condition h0\ninitial h = h0")


def dropped(heights: Sequence[float], span: float) -> Trajectories:
    times = np.linspace(0.0, span, 9)[1:]
    made = [
        replace(trajectory(str(i), 0.0, times, np.ones((8, 2)), []), condition=np.array([height]))
        for i, height in enumerate(heights)
    ]
    return Trajectories(tuple(made), ("h", "n"))


@pytest.mark.parametrize(("e", "g"), [(0.5, 7.3), (0.52, 12.0), (0.6, 14.0)])
def test_a_ball_that_comes_to_rest_does_not_fall_through_the_floor(e: float, g: float) -> None:
    """Its bounces become shorter than rounding can tell; there is no solution from there on, and another trajectory
    keeps its own."""
    problem, parameters, theta = problem_of(model_of(DROPPED), dropped([5.0, 60.0], 5.5), 0.1, blend=0.0)
    theta = parameters.vector(parameters.natural(theta), np.array([e, g]))
    rest = (1 + e) / (1 - e) * np.sqrt(2 * 5.0 / g)
    assert rest < 5.4, "it comes to rest before the last row"
    packed = problem.packed
    ends = (packed.row_trajectory == 0) & (packed.row_time > rest)
    tables = [residual_table(engine, theta) for engine in engines_of(problem, parameters)]
    for table in tables:
        assert np.isnan(table[ends]).all() and np.isfinite(table[~ends]).all()
    assert np.abs(tables[1] - tables[0])[~ends].max() < 1e-8
