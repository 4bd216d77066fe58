"""The kernel solves algebraic equations like the torch graph, with the same derivatives."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.ir import STIFF
from gbspec.training.engines.engine import Unable
from gbspec.training.engines.native.kernel import kernel_of
from gbspec.training.problem.mesh import Control
from tests.algebraic.models import ARRAY, BUFFER, TWO_ROOTS, UNKNOWN, built
from tests.backends.same_kernel import compare, compare_jacobians
from tests.training.conftest import problem_of, trajectory

TANK = (
    BUFFER.replace("learn k = 0.2 in [0, 1]\n", "unknown r(pH) by mlp(4)\n")
    .replace("k*a*pH/7", "r*a")
    .replace("truth k = 0.3\n", "")
)
COUPLED = """model coupled
state x in [0, 4] = 1
learn s = 0.7 in [0.1, 2]
algebraic y in [-5, 5] = 1
algebraic z in [-5, 5] = 0.1
algebraic w in [0, 5] = 1
x' = 1 - y + 0.1*w*z
equation one: y + s*z^3 = x
equation two: z + 0.3*y^2 = s
equation three: w^3 + w = z^2 + s*x
observe x
observe total = y + w*z
"""


def rows(channels: tuple[str, ...], start: list[float]) -> Trajectories:
    """Two trajectories of made-up values near `start`."""
    made = []
    for label, factor in (("1", 1.0), ("2", 1.1)):
        times = np.array([0.3, 0.8, 1.0, 2.0])
        values = np.outer(factor * (1.0 + 0.1 * times), start)
        made.append(trajectory(label, 0.0, times, values, []))
    return Trajectories(tuple(made), channels)


CASES = {
    "tank": (TANK, ("pH", "a"), [5.0, 0.02]),
    "tank_known": (BUFFER, ("pH", "a"), [5.0, 0.02]),
    "coupled": (COUPLED, ("x", "total"), [1.0, 0.8]),
    "two_roots": (TWO_ROOTS, ("x", "y"), [1.0, 1.0]),
    "rows": (ARRAY, tuple(f"{name}[{i}]" for name in "cq" for i in (1, 2, 3)), [1.0, 0.9, 1.1, 0.5, 0.4, 0.6]),
}


@pytest.mark.parametrize("case", CASES)
def test_kernel_and_graph_agree(case: str) -> None:
    text, channels, start = CASES[case]
    model = built(text)
    problem, parameters, theta = problem_of(model, rows(channels, start), 0.25, blend=0.0)
    if isinstance(kernel_of(model, type(problem.module)), Unable):
        pytest.skip("no C compiler")
    compare(problem, parameters, theta, ("float64",))
    compare_jacobians(problem, parameters, theta)


def test_the_stiff_solver_serves_them_too() -> None:
    text, channels, start = CASES["tank"]
    model = built(text)
    problem, parameters, theta = problem_of(model, rows(channels, start), 10.0, blend=0.0, method=STIFF)
    problem = replace(problem, control=Control(1e-4, np.ones(2)))
    if isinstance(kernel_of(model, type(problem.module)), Unable):
        pytest.skip("no C compiler")
    compare_jacobians(problem, parameters, theta)


def test_unknowns_inside_the_equations_are_left_to_the_graph() -> None:
    model = built(UNKNOWN)
    found = kernel_of(model, load_module(model))
    assert isinstance(found, Unable)
    assert re.search("an unknown function stands in its algebraic equations", found.reason)
