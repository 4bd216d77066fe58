"""Doses in training: fractions and lags, known and learned, and their derivatives."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories
from gbspec.ir.model import Model
from gbspec.training import TrainOptions, train
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.native.kernel import Kernel, kernel_of
from gbspec.training.engines.objective import objective
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.backends.same_kernel import compare
from tests.training.conftest import model_of, problem_of, trajectory
from tests.training.reference import half_squares, linearise, measured_residuals, solve, unroll, whole_jacobian

DEPOT = """model depot
time t from 0
state gut in [0, 100]
state blood in [0, 20]
learn F = 0.5 in [0, 1]
learn tlag = 0.3 in [0, 2]
learn ka = 1 > 0
const V = 10
gut' = -ka*gut
blood' = ka*gut/V - 0.3*blood
initial gut = 0
initial blood = 0
dose gut times F lag tlag
observe blood
truth F = 0.7
truth tlag = 0.63
truth ka = 1.4
"""

MANY = """model many
time t from 0
state a in [0, 2]
state b in [0, 2]
condition c in [0, 1]
input G linear
learn k = 0.5 in [0, 3]
learn own = 0.4 > 0 per trajectory
unknown f(a, b) by mlp(5, 4, activation=tanh)
const early = 0.2
a' = -k*a + 0.3*f + 0.2*G
b' = 0.3*a - own*b + 0.1*f(b, a) + 0.1*t
dose a times 0.5 + 0.2*k lag 0.3*own + 0.1*c
dose b lag early
observe a
observe total = a + b
"""


def many_data() -> Trajectories:
    """Several doses at once, before a row, at a row, and after the last."""
    rng = np.random.default_rng(3)
    items = []
    for i in range(3):
        times = np.array([0.0, 0.4, 0.9, 1.3, 2.0])[: 4 + (i > 0)]
        values = rng.uniform(0.3, 1.5, (len(times), 2))
        values[rng.random(values.shape) < 0.3] = np.nan
        into_a = DoseEvents(np.array([0.0, 0.01, 0.9, 3.0]), rng.uniform(0.2, 0.6, 4))
        into_b = DoseEvents(np.array([0.2, 0.7]), rng.uniform(0.2, 0.6, 2))
        linear = Signal(np.array([0.1, 0.5, 1.3]), rng.uniform(0, 1, 3))
        items.append(trajectory(str(i), 0.0, times, values, [0.2 * i], inputs=(linear,), doses=(into_a, into_b)))
    return Trajectories(tuple(items), ("a", "total"))


def depot_data(model: Model, subjects: int = 4) -> Trajectories:
    """Exact measurements at the truth, by the adaptive solver; the second dose falls between two rows."""
    module = load_module(model)()
    truth = {"F": 0.7, "tlag": 0.63, "ka": 1.4}
    module.weights["constants"] = np.array(
        [truth.get(n, v) for n, v in zip(module.constants, module.weights["constants"], strict=True)]
    )
    evaluator, items = Evaluator(module), []
    for i in range(subjects):
        times = np.arange(1, 13) * 0.5 + 0.03 * i
        events = DoseEvents(np.array([0.0, 2.3]), np.array([100.0, 60.0 + 10 * i]))
        x = evaluator.integrate(np.zeros(2), times, start=0.0, doses=(events,))
        items.append(trajectory(str(i), 0.0, times, x[:, 1:], [], doses=(events,)))
    return Trajectories(tuple(items), ("blood",), "made.csv", "0" * 64)


@pytest.mark.parametrize("blend", [1.0, 0.0])
def test_the_jacobian_of_doses_is_exact(blend: float) -> None:
    problem, parameters, theta = problem_of(model_of(MANY), many_data(), 0.13, blend=blend)
    found = whole_jacobian(linearise(problem, parameters, theta), parameters)
    expected = torch.autograd.functional.jacobian(
        lambda v: measured_residuals(problem, unroll(problem, parameters, v).residuals),
        torch.from_numpy(theta),
        vectorize=True,
    )
    assert float((found - expected).abs().max()) < 1e-10 * float(expected.abs().max())
    h = 1e-6
    direction = np.random.default_rng(0).standard_normal(len(theta))
    ahead, behind = (solve(problem, parameters, theta + s * h * direction) for s in (1, -1))
    assert np.allclose((ahead - behind) / (2 * h), found.numpy() @ direction, rtol=0, atol=1e-6)


def test_residuals_do_not_jump_where_a_dose_moves_over_rows_and_steps() -> None:
    model = model_of(DEPOT)
    problem, parameters, theta = problem_of(model, depot_data(model, 1), 0.1, blend=0.0)
    column = parameters.n_weights + 1
    largest = []
    for count in (31, 61):
        values = []
        for u in np.linspace(-0.3, 0.3, count):
            theta[column] = u
            values.append(solve(problem, parameters, theta))
        largest.append(float(np.abs(np.diff(np.array(values), axis=0)).max()))
    assert largest[1] < 0.6 * largest[0], "a jump would be as large however small the step of the lag"


def test_training_solves_doses_as_the_evaluator_does() -> None:
    model = model_of(DEPOT)
    data = depot_data(model)
    problem, parameters, _ = problem_of(model, data, 0.02, blend=0.0)
    weights = {}
    theta = parameters.vector(weights, np.array([0.7, 0.63, 1.4]))
    assert np.abs(solve(problem, parameters, theta)).max() < 1e-6


def same_by_the_kernel(problem: Problem, parameters: Parameters, theta: np.ndarray) -> None:
    """Loss, gradient and Jacobian of the kernel are the torch graph's."""
    try:
        find_compiler()
    except CompilerError as error:
        pytest.skip(str(error))
    compare(problem, parameters, theta, ("float64", "float32"))


@pytest.mark.usefixtures("quick_fit")
def test_a_lag_that_conditions_set_by_the_kernel() -> None:
    text = MANY.replace("lag 0.3*own + 0.1*c", "lag early + 0.3*c")
    problem, parameters, theta = problem_of(model_of(text), many_data(), 0.13, blend=0.3)
    assert all(problem.packed.doses.known)
    same_by_the_kernel(problem, parameters, theta)


@pytest.mark.parametrize("blend", [1.0, 0.3, 0.0])
def test_learned_lags_by_the_kernel(blend: float) -> None:
    """Doses of learned and of known lags, several in a sub-step, inputs and the time in the balances."""
    problem, parameters, theta = problem_of(model_of(MANY), many_data(), 0.13, blend=blend)
    assert not all(problem.packed.doses.known)
    assert Paths(problem).at(parameters, theta).packed.substeps > problem.packed.substeps
    for seed in range(2):
        moved = theta + 0.1 * np.random.default_rng(seed).standard_normal(len(theta))
        same_by_the_kernel(problem, parameters, moved)


@pytest.mark.usefixtures("quick_fit")
def test_a_lag_that_ends_at_a_row_by_the_kernel() -> None:
    """At the middle of its range the lag is 1, where a row lies: one part of the sub-step has no length."""
    model = model_of(DEPOT)
    problem, parameters, theta = problem_of(model, depot_data(model), 0.1, blend=0.0)
    for u in (-0.2, 0.0, 1e-13):
        theta[parameters.n_weights + 1] = u
        same_by_the_kernel(problem, parameters, theta)


@pytest.mark.parametrize("shift", [-0.3, 2.5])
def test_learned_lags_before_the_start_and_beyond_the_end_by_the_kernel(shift: float) -> None:
    text = MANY.replace("lag 0.3*own + 0.1*c", f"lag 0.3*own + 0.1*c {shift:+}")
    problem, parameters, theta = problem_of(model_of(text), many_data(), 0.13, blend=0.3)
    same_by_the_kernel(problem, parameters, theta)


@pytest.mark.usefixtures("quick_fit")
def test_learned_lags_in_parts_of_solutions_and_of_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """With only some sub-steps' activations kept, on two threads, and for some trajectories."""
    problem, parameters, theta = problem_of(model_of(MANY), many_data(), 0.02, blend=0.3)
    same_by_the_kernel(problem, parameters, theta)
    whole = kernel_of(problem.model, type(problem.module))
    monkeypatch.setattr(sys.modules["gbspec.backends.native.kernel_text"], "KEPT_BYTES", 12_000)
    monkeypatch.setattr("gbspec.training.engines.native.kernel._kernels", {})
    same_by_the_kernel(problem, parameters, theta)
    kernel, index = kernel_of(problem.model, type(problem.module)), np.array([2, 0])
    assert isinstance(kernel, Kernel)
    assert isinstance(whole, Kernel)
    assert kernel.work_bytes(500) < whole.work_bytes(500)
    part, local = problem.take(index), parameters.take(index)
    loss, gradient = half_squares(kernel, part, local, parameters.take_vector(theta, index))
    found = half_squares(kernel, problem, parameters, theta, index)
    assert found[0] == pytest.approx(loss, rel=1e-13)
    assert np.allclose(parameters.take_vector(found[1], index), gradient, rtol=1e-11, atol=1e-13)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert np.allclose(half_squares(kernel, problem, parameters, theta, index)[1], found[1], rtol=1e-11, atol=1e-13)


@pytest.mark.usefixtures("quick_fit")
def test_a_dose_that_only_constants_describe_in_a_model_that_learns_none() -> None:
    text = """model fixed
time t from 0
state x in [0, 2]
const lagc = 0.3
const share = 0.6
unknown g(x) by mlp(4)
x' = -x + g
dose x times share lag lagc
observe x
"""
    dosed = trajectory("1", 0.0, np.arange(1.0, 4.0), np.ones((3, 1)), [], doses=(DoseEvents(np.ones(1), np.ones(1)),))
    problem, parameters, theta = problem_of(model_of(text), Trajectories((dosed,), ("x",)), 0.25, blend=0.5)
    same_by_the_kernel(problem, parameters, theta)


@pytest.mark.usefixtures("quick_fit")
@pytest.mark.parametrize("conditions", [(0.0, 0.0), (0.5, 0.0)])
def test_a_learned_lag_that_a_condition_leaves_undefined_has_no_gradient(conditions: tuple[float, ...]) -> None:
    model = model_of(DEPOT.replace("state gut", "condition c in [0, 1]\nstate gut").replace("lag tlag", "lag tlag/c"))
    values = np.linspace(0.1, 0.5, 9)[:, None]
    items = tuple(
        trajectory(str(i), 0.0, np.arange(1.0, 10.0), values, [c], doses=(DoseEvents(np.zeros(1), np.ones(1)),))
        for i, c in enumerate(conditions)
    )
    problem, parameters, theta = problem_of(model, Trajectories(items, ("blood",)), 0.25, blend=0.0)
    theta[parameters.n_weights + 1] = -0.2
    assert np.isfinite(objective(problem, parameters, "torch")(theta)[1]).all()
    if any(conditions):
        same_by_the_kernel(problem, parameters, theta)
    else:
        assert np.abs(objective(problem, parameters, "native")(theta)[1]).max() == 0.0


def test_a_trajectory_taken_twice_gets_its_doses_twice() -> None:
    problem, parameters, theta = problem_of(model_of(MANY), many_data(), 0.2)
    index = np.array([2, 0, 2])
    part, local = problem.take(index), parameters.take(index)
    whole = unroll(problem, parameters, torch.from_numpy(theta))
    some = unroll(part, local, torch.from_numpy(parameters.take_vector(theta, index)))
    for new, old in enumerate(index):
        mine, theirs = part.packed.row_trajectory == new, problem.packed.row_trajectory == old
        assert torch.allclose(some.before[mine], whole.before[theirs], rtol=1e-13, atol=1e-13)


@pytest.mark.usefixtures("quick_fit")
def test_learns_the_fraction_and_the_lag(tmp_path: Path) -> None:
    model = model_of(DEPOT)
    run = train(model, depot_data(model, 2), TrainOptions(effort="low", max_step=0.25), tmp_path / "run")
    constants = run.fit.constants
    for name, value in {"F": 0.7, "tlag": 0.63, "ka": 1.4}.items():
        assert constants[name].value == pytest.approx(value, rel=1e-3), name


@pytest.mark.parametrize("lag", ["1/c", "log(c)", "sqrt(c - 1)"])
def test_a_lag_that_a_condition_leaves_undefined_never_ends(lag: str) -> None:
    """The dose does not arrive, as if it came after the end."""
    text = DEPOT.replace("learn tlag = 0.3 in [0, 2]\n", "condition c in [0, 1]\n").replace("lag tlag", f"lag {lag}")
    model = model_of("\n".join(line for line in text.splitlines() if not line.startswith("truth")) + "\n")
    values = np.linspace(0.1, 0.5, 5)[:, None]
    dosed = trajectory("1", 0.0, np.arange(1.0, 6.0), values, [0.0], doses=(DoseEvents(np.zeros(1), np.ones(1)),))
    problem, parameters, theta = problem_of(model, Trajectories((dosed,), ("blood",)), 0.25, blend=0.0)
    assert np.isfinite(solve(problem, parameters, theta)).all()
    assert float(np.abs(unroll(problem, parameters, torch.from_numpy(theta)).before.numpy()).max()) == 0.0
