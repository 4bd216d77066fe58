"""Every method in every backend: same numbers, the stated order, exact derivatives; also for an additional method."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gbspec.backends.c import c_code
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.casadi.steps import plan
from gbspec.backends.module import generate, load_module
from gbspec.backends.native import CompilerError, compiler
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.diagnostics import Defect
from gbspec.ir.methods import METHODS, Explicit, Method, RosenbrockW
from gbspec.ir.model import Model
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.kernel import Kernel, kernel_of
from gbspec.training.engines.objective import predicted
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.backends.same_kernel import compare
from tests.training.conftest import EVERYTHING, everything_data, model_of, problem_of
from tests.training.reference import kernel_residuals, linearise, measured_residuals, unroll, whole_jacobian
from tests.training.test_arrays import COLUMN, column_data
from tests.training.test_doses import MANY, many_data

Array = NDArray[np.float64]

_F = Fraction
RALSTON = Explicit(
    "ralston",
    3,
    a=((), (_F(1, 2),), (_F(0), _F(3, 4))),
    b=(_F(2, 9), _F(1, 3), _F(4, 9)),
    source="Ralston (1962), Math. Comp. 16, 431",
    help="Ralston's, of order 3",
)
"""A method that is not in the table; none of its nodes is the end of the step."""
EULER = Explicit("euler", 1, a=((),), b=(_F(1),), source="Euler (1768)", help="Euler's, of order 1")
EVERY = [*METHODS, RALSTON.name, EULER.name]
FEWER = [*METHODS, RALSTON.name]
"""The methods for slow tests; Euler's would add nothing to Ralston's."""


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Adds two methods by an entry each."""
    for method in (RALSTON, EULER):
        monkeypatch.setitem(METHODS, method.name, method)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def needs_a_compiler() -> None:
    try:
        compiler.find_compiler()
    except CompilerError as error:
        pytest.skip(str(error))


def close(found: Any, wanted: Any, bound: float = 1e-12) -> None:
    """Asserts agreement relative to the largest entry."""
    found, wanted = np.asarray(found, dtype=np.float64), np.asarray(wanted, dtype=np.float64)
    assert found.shape == wanted.shape and np.isfinite(wanted).all() and wanted.size
    assert np.abs(found - wanted).max() <= bound * np.abs(wanted).max()


# ------------------------------------------------------------------------------------------------ one step
@pytest.mark.parametrize("name", EVERY)
def test_the_module_names_its_method(name: str) -> None:
    model = model_of(EVERYTHING)
    text = generate(model, METHODS[name])
    assert f'    solver: ClassVar[str] = "{name}"  # the method that takes the steps\n' in text
    assert f"\nSolver      {name}: {METHODS[name].help}\n" in text
    assert f"One step ({name.upper()}) of state'" in text and f"a step of size h from t ({name.upper()})" in text
    assert load_module(model, METHODS[name]).solver == name


def by_hand(method: Method, instance: Any, t: float, x: Array, h: float, condition: Array, inputs: Array) -> Array:
    """A step computed from the coefficients, with the inputs [nodes, n_inputs]."""
    slopes: list[Array] = []
    matrix = h * slopes_of(instance, t, x, condition, inputs)

    def summed(row: Any) -> Array:
        return np.asarray(sum((float(w) * k for w, k in zip(row, slopes, strict=False)), np.zeros_like(x)))

    for i, (row, c) in enumerate(zip(method.a, method.c, strict=True)):
        ahead = x + h * summed(row)
        rate = instance.rhs(t + float(c) * h, ahead, condition, inputs[method.nodes.index(c)]).numpy()
        if isinstance(method, RosenbrockW):
            divided = np.eye(len(x)) - float(method.gamma) * matrix
            rate = np.linalg.solve(divided, rate + matrix @ summed(method.g[i]))
        slopes.append(rate)
    return np.asarray(x + h * summed(method.b))


def slopes_of(instance: Any, t: float, x: Array, condition: Array, inputs: Array) -> Array:
    """The Jacobian of the right-hand side at the start of a step."""
    found = torch.autograd.functional.jacobian(lambda at: instance.rhs(t, at, condition, inputs[0]), torch.tensor(x))
    return np.asarray(found.numpy())


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.usefixtures("needs_a_compiler")
def test_a_step_by_torch_numpy_and_c_is_that_of_the_tableau(name: str, tmp_path: Path) -> None:
    method = METHODS[name]
    instance = load_module(model_of(EVERYTHING), method).random(1)
    rng = np.random.default_rng(0)
    x, condition, inputs = rng.uniform(0.3, 1.2, 3), np.array([0.4]), rng.uniform(0, 1, (len(method.nodes), 2))
    wanted = by_hand(method, instance, 0.2, x, 0.3, condition, inputs)

    def tensor(value: Any) -> torch.Tensor:
        return torch.as_tensor(value, dtype=torch.float64)

    for library, given in (("torch", tensor), ("numpy", np.asarray)):
        m = instance.arithmetic(library)
        networks = (
            instance.numpy_networks()
            if library == "numpy"
            else instance.torch_networks({k: tensor(v) for k, v in instance.weights.items()})
        )
        constants = tuple(given(value) for value in instance.weights["constants"])
        rhs = instance.equations.field(m, given(condition), constants, networks)
        grid = instance.equations.grid(m, given(0.2), given(0.3))
        solve = []
        if isinstance(method, RosenbrockW) and library == "numpy":  # which has no exact derivatives
            size = 0.3 * float(method.gamma)
            matrix = np.eye(3) - size * slopes_of(instance, 0.2, x, condition, inputs)
            solve = [lambda b, matrix=matrix: np.linalg.solve(matrix, b)]
            by_differences = m.factored(rhs, given(0.2), given(x), given(inputs[0]), given(size))
            close(by_differences(x), solve[0](x), 1e-9)
        close(instance.equations.step(m, rhs, grid, given(x), tuple(map(given, inputs)), *solve), wanted)
    step = casadi.external("step", c_library(instance, tmp_path))
    close(np.array(step(0.2, x, 0.3, condition, *inputs)).ravel(), wanted)


def c_library(instance: Any, directory: Path) -> str:
    """casadi's C of a module, compiled."""
    text = c_code(instance)
    comment = text.partition("*/")[0]
    assert f"(`{instance.solver}`)" in comment
    (directory / "model.c").write_text(text, encoding="utf-8")
    command = [shutil.which("cc") or "gcc", "-std=c99", "-O0", "-shared", "-fPIC", "-o", "model.so", "model.c", "-lm"]
    subprocess.run(command, cwd=directory, check=True, capture_output=True)
    return str(directory / "model.so")


def test_the_c_code_states_the_times_of_the_inputs() -> None:
    text = c_code(load_module(model_of(EVERYTHING), METHODS["rk38"]).random(1))
    assert "step: Kutta's 3/8 rule, of order 4 (`rk38`)" in text
    assert "inputs, u0, u1, u2, u3: F, G" in text
    assert "step takes them at the times t, t + 1/3*h, t + 2/3*h, t + h" in text


# ------------------------------------------------------------------------------------------------ solutions
def dosed_data() -> Trajectories:
    """Asserts that no dose arrives within rounding of a row, where the solvers could order them differently."""
    data = many_data()
    items = [replace(i, doses=(i.doses[0], replace(i.doses[1], times=np.array([0.2, 0.65])))) for i in data.items]
    return replace(data, items=tuple(items))


Case = tuple[str, Any, float]
CASES: dict[str, Case] = {
    "inputs": (EVERYTHING, everything_data, 0.13),
    "doses": (MANY, dosed_data, 1e3),
    "arrays": (COLUMN, column_data, 0.1),
}
"""Held and linear inputs; doses with learned lags, with steps so long that all solvers take the same ones; arrays."""


def solved_by_casadi(
    problem: Problem, parameters: Parameters, theta: Array, data: Trajectories, initial: Array
) -> list[Array]:
    """States at the rows of each trajectory, by the evaluator."""
    constants = parameters.constants(torch.from_numpy(theta)).numpy()
    evaluator = Evaluator(type(problem.module)(parameters.natural(theta)))
    return [
        evaluator.integrate_fixed(
            initial[i],
            item.times,
            item.condition,
            item.inputs,
            item.start,
            max_step=problem.packed.max_step,
            doses=item.doses,
            constants=constants[i],
        )
        for i, item in enumerate(data.items)
    ]


def solved_by_c(
    problem: Problem, parameters: Parameters, theta: Array, item: Trajectory, initial: Array, directory: Path
) -> Array:
    """States at the rows of the first trajectory, by the step in C."""
    natural = parameters.natural(theta)
    natural["constants"] = parameters.constants(torch.from_numpy(theta)).numpy()[0]
    instance = type(problem.module)(natural)
    evaluator = Evaluator(instance)
    pieces = evaluator._segments(item.start, item.times, item.condition, item.inputs, item.doses, None)
    sizes = len(initial), len(item.inputs)
    steps = plan(item.start, item.times, pieces, problem.packed.max_step, *sizes, METHODS[instance.solver])
    step = casadi.external("step", c_library(instance, directory))
    path = [initial]
    for i, (t, h) in enumerate(zip(steps.times, steps.sizes, strict=True)):
        after = step(t, path[-1] + steps.jumps[i], h, item.condition, *steps.inputs[:, i])
        path.append(np.array(after).ravel())
    return np.array(path)[steps.after]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", FEWER)
@pytest.mark.usefixtures("needs_a_compiler")
def test_solutions_by_torch_native_casadi_and_c_are_the_same(name: str, case: str, tmp_path: Path) -> None:
    text, make, step = CASES[case]
    data: Trajectories = make()
    problem, parameters, theta = problem_of(model_of(text), data, step, blend=0.0, method=METHODS[name])
    with torch.no_grad():
        graph = unroll(problem, parameters, torch.from_numpy(theta))
    kernel = kernel_of(problem.model, type(problem.module))
    assert isinstance(kernel, Kernel)
    engine = NativeEngine(problem, parameters, kernel)
    found = predicted(engine, theta)
    initial = found.initial
    close(found.before, graph.before)
    close(kernel_residuals(engine, theta), graph.residuals)
    packed = problem.packed
    mine = [packed.row_table[i, : len(item.times)] for i, item in enumerate(data.items)]
    for rows, states in zip(mine, solved_by_casadi(problem, parameters, theta, data, initial), strict=True):
        close(states, graph.before.numpy()[rows])
    by_c = solved_by_c(problem, parameters, theta, data.items[0], initial[0], tmp_path)
    close(by_c, graph.before.numpy()[mine[0]])


@pytest.mark.parametrize("name", FEWER)
@pytest.mark.usefixtures("needs_a_compiler")
@pytest.mark.parametrize(("case", "step"), [("inputs", 0.13), ("doses", 0.13), ("arrays", 0.3)])
def test_gradients_and_jacobians_of_the_kernel_are_those_of_the_graph(name: str, case: str, step: float) -> None:
    text, make, _ = CASES[case]
    problem, parameters, theta = problem_of(model_of(text), make(), step, blend=0.3, method=METHODS[name])
    # of explicit methods, one with numbers of single precision: their sources differ in the tableau
    compare(problem, parameters, theta, ("float64", "float32") if name in ("dopri5", "ros34pw2") else ("float64",))


@pytest.mark.parametrize("name", ["dopri5", RALSTON.name, "ros34pw2"])
@pytest.mark.parametrize("case", ["inputs", "doses"])
def test_the_jacobian_is_that_of_automatic_differentiation(name: str, case: str) -> None:
    text, make, _ = CASES[case]
    problem, parameters, theta = problem_of(model_of(text), make(), 0.3, blend=0.3, method=METHODS[name])
    found = whole_jacobian(linearise(problem, parameters, theta), parameters)
    expected = torch.autograd.functional.jacobian(
        lambda v: measured_residuals(problem, unroll(problem, parameters, v).residuals),
        torch.from_numpy(theta),
        vectorize=True,
    )
    close(found, expected, 1e-10)


def test_data_packed_for_another_method_are_rejected() -> None:
    problem, _, _ = problem_of(model_of(EVERYTHING), everything_data(), 0.3)
    with pytest.raises(Defect, match="another method than `dopri5`"):
        replace(problem, module=load_module(problem.model, METHODS["dopri5"]).random(0))


# ------------------------------------------------------------------------------------------------ order
DRIVEN = """model driven
time t from 0
state x
state y
input u linear
const a = 1.3
x' = -a*x*y + u*cos(3*t)
y' = sin(x) - y*u + 0.5*t
observe x
"""


@pytest.mark.parametrize("name", EVERY)
def test_the_order_is_measured(name: str) -> None:
    """Errors decrease by 2^order when the step is halved, with explicit time and a varying input."""
    method = METHODS[name]
    instance = load_module(model_of(DRIVEN), method)()
    start, times = [0.8, -0.3], [0.0, 1.0, 2.0]

    def signal(t: float) -> list[float]:
        return [0.5 + 0.9 * t]

    def at(h: float, by: Any = instance) -> Array:
        found: Array = by.simulate(start, times, inputs=signal, max_step=h).numpy()
        return found

    exact = at(1 / 256, load_module(model_of(DRIVEN), METHODS["dopri5"])())
    steps = (1 / 32, 1 / 64) if method.order > 3 else (1 / 64, 1 / 128)
    coarse, fine = (np.abs(at(h) - exact).max() for h in steps)
    assert np.log2(coarse / fine) == pytest.approx(method.order, abs=0.25)
    ramp = _Ramp(np.array([0.0, 2.0]), np.array([0.5, 2.3]))
    close(Evaluator(instance).integrate_fixed(start, times, inputs=(ramp,), start=0.0, max_step=steps[0]), at(steps[0]))


class _Ramp:
    """A signal of the evaluator."""

    def __init__(self, times: Array, values: Array) -> None:
        self.times, self.values = times, values


def test_a_model_does_not_depend_on_the_method() -> None:
    fields = {field for field in Model.__dataclass_fields__ if "solver" in field or "method" in field}
    assert not fields
