"""The native kernel has the same delays as the torch graph: values, gradients and Jacobians agree."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from gbspec.backends.native import CompilerError, NotCoveredError, source
from gbspec.backends.native.compiler import find_compiler
from gbspec.data.trajectories import Trajectories
from gbspec.ir import METHODS, Model
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.engines.native.kernel import Kernel, kernel_of
from gbspec.training.engines.objective import objective, predicted
from gbspec.training.starts.search import PATIENCE, patience_of
from tests.backends.same_kernel import compare
from tests.delays.models import EVERYTHING, MACKEY_GLASS, everything_data
from tests.training.conftest import model_of, problem_of, trajectory

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.usefixtures("quick_fits")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


UNKNOWNS = """model unknowns
time t from 0
state x in [0, 3]
state y in [0, 2]
condition c in [0.5, 1.5]
learn tau = 0.9 in [0.2, 2]
learn k = 0.6 in [0, 3] per trajectory
unknown f(x, y) >= 0, increasing in x by mlp(5, 3)
unknown g(x) by mlp(4)
let made = f(x, y) + 0.1*t
let lost = g(y)
x' = delay(made, tau) - k*x - 0.2*delay(lost, tau)
y' = delay(lost, 0.45) + g(delay(x, 0.45*c)) - y
initial x = 0.4 + 0.3*k
history x = 0.4 + 0.3*k + 0.2*sin(t)*c
history y = 0.7
observe x
observe z = delay(made, tau) + g(delay(y, 0.45)) + x
"""

LINEAR = """model line
time t from 0
state x in [0, 9]
learn tau = 0.5 in [0.2, 2]
x' = -delay(x, tau)
observe x
observe before = delay(x, tau)
"""


def drawn_model(rng: np.random.Generator) -> Model:
    """Two states with random delays: known, learned and by a condition, of states, an input and a `let`."""
    lags = ["tau", "r", "tau + r", "0.37", "0.31*c", "tau*c"]
    values = ["x", "y", "F", "made"]

    def late() -> str:
        return f"delay({rng.choice(values)}, {rng.choice(lags)})"

    lines = [
        "model drawn\ntime t from 0\nstate x in [0, 3]\nstate y in [0, 2]\ncondition c in [0.5, 1.5]",
        f"input F {rng.choice(['linear', 'held'])}",
        "learn tau = 0.8 in [0.1, 2]",
        f"learn r = 0.6 in [0.15, 3]{rng.choice(['', ' per trajectory'])}",
        f"unknown f(x, y) by mlp({rng.integers(1, 7)})",
        f"let made = {rng.choice(['x*y + F', 'f(y, x)', 'exp(-x)*t'])}",
        f"x' = {late()} - x*{late()} + f({late()}, y)",
        f"y' = {late()}/(1 + {late()}^2) - {rng.choice(['y', 'y*x', 'tau*y'])}",
        *(["initial x = 0.5 + 0.2*r"] if rng.random() < 0.5 else []),
        *(["history x = 0.5 + 0.2*r*cos(t)"] if rng.random() < 0.5 else []),
        *(["history y = 0.8 + 0.1*t"] if rng.random() < 0.5 else []),
        *(["dose y times 0.5*tau"] if rng.random() < 0.5 else ["dose y"]),
        f"observe x\nobserve z = {rng.choice(['y', 'y*x', 'made'])} + {late()} + 0.1*tau*r",
    ]
    return model_of("\n".join(lines))


def some_data(channels: tuple[str, ...], conditions: int = 1, seed: int = 0, first: float = 0.0) -> Trajectories:
    """Trajectories of different lengths; one has a single measurement, at `first`."""
    rng = np.random.default_rng(seed)
    items = []
    for i in range(6):
        times = np.cumsum(rng.gamma(4, 0.12, 4 + i)) if i else np.array([first])
        values = rng.uniform(0.3, 1.5, (len(times), len(channels)))
        values[rng.random(values.shape) < 0.2 * (i > 0)] = np.nan
        given = rng.uniform(0.7, 1.3, conditions)
        items.append(trajectory(str(i), 0.0, times, values, given))
    return Trajectories(tuple(items), channels)


@pytest.mark.parametrize(("seed", "blend"), [(0, 0.0), (1, 0.4), (0, 1.0)])
def test_a_model_with_everything(seed: int, blend: float) -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(seed), 0.19, seed, blend=blend)
    compare(problem, parameters, theta, ("float64", "float32"))


@pytest.mark.parametrize("seed", range(5))
def test_random_models(seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = everything_data(seed)
    problem, parameters, theta = problem_of(
        drawn_model(rng), data, float(rng.choice([0.13, 0.23, 0.6])), seed, blend=float(rng.choice([0.0, 0.3, 1.0]))
    )
    compare(problem, parameters, theta + 0.1 * rng.standard_normal(len(theta)), ("float64",))


@pytest.mark.parametrize("method", ["rk38", "dopri5"])
def test_other_methods(method: str) -> None:
    problem, parameters, theta = problem_of(
        model_of(EVERYTHING), everything_data(3), 0.2, 3, blend=0.0, method=METHODS[method]
    )
    compare(problem, parameters, theta, ("float64",))


def test_no_stiff_method() -> None:
    with pytest.raises(NotCoveredError, match="explicit"):
        source(model_of(MACKEY_GLASS), method=METHODS["ros34pw2"])


@pytest.mark.parametrize("blend", [0.0, 0.7])
@pytest.mark.parametrize("first", [0.0, 0.8])
def test_unknowns_in_what_is_delayed_and_a_trajectory_without_steps(first: float, blend: float) -> None:
    problem, parameters, theta = problem_of(
        model_of(UNKNOWNS), some_data(("x", "z"), 1, 4, first), 0.15, 1, blend=blend
    )
    assert (problem.packed.steps == 0).any() == (first == 0.0)
    compare(problem, parameters, theta, ("float64", "float32"))


@pytest.mark.parametrize("blend", [0.0, 0.5, 1.0])
def test_regular_times_at_which_delays_meet_measurements(blend: float) -> None:
    """Every delayed jump of a reset falls on the end of a step: the side of it that counts is the same."""
    times = np.arange(1, 13) * 0.5
    rng = np.random.default_rng(0)
    items = [trajectory(str(i), 0.0, times[: 5 + 2 * i], rng.uniform(0.5, 1.5, (5 + 2 * i, 2)), []) for i in range(3)]
    data = Trajectories(tuple(items), ("x", "before"))
    problem, parameters, _ = problem_of(model_of(LINEAR), data, 0.25, 0, blend=blend)
    for tau in (0.75, 1.0, 1.25, 0.6180339887):
        starts = np.full((3, 1), 0.2)
        theta = parameters.vector({}, np.array([tau]))
        theta[parameters.n_shared :] = starts.ravel()
        compare(problem, parameters, theta, ("float64",))


def test_steps_as_long_as_the_delay_and_much_shorter_ones() -> None:
    text = LINEAR.replace("learn tau = 0.5 in [0.2, 2]", "learn tau = 0.5 in [0.499999, 0.6]")
    for step in (10.0, 0.07):
        problem, parameters, _ = problem_of(model_of(text), some_data(("x", "before"), 0, 1, 0.4), step, 0, blend=0.0)
        for tau in (0.499999, 0.53):
            compare(problem, parameters, parameters.vector({}, np.array([tau])), ("float64",))


def test_what_is_not_kept_is_computed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of(UNKNOWNS)
    problem, parameters, theta = problem_of(model, some_data(("x", "z"), 1, 5, 0.3), 0.05, 3, blend=0.2)
    whole = objective(problem, parameters, "native")(theta)
    monkeypatch.setattr(sys.modules["gbspec.backends.native.kernel_text"], "KEPT_BYTES", 20_000)
    monkeypatch.setattr("gbspec.training.engines.native.kernel._kernels", {})
    kernel = kernel_of(model, type(problem.module))
    assert isinstance(kernel, Kernel) and kernel.library.sizes["KEPT_BYTES"] == 20_000
    again = objective(problem, parameters, "native")(theta)
    assert again[0] == whole[0]
    assert np.allclose(again[1], whole[1], rtol=1e-12, atol=1e-14 * np.abs(whole[1]).max())
    compare(problem, parameters, theta, ("float64",))


def test_threads_and_some_of_the_trajectories() -> None:
    problem, parameters, theta = problem_of(model_of(UNKNOWNS), some_data(("x", "z"), 1, 6, 0.3), 0.2, 3, blend=0.0)
    one = objective(problem, parameters, "native")(theta)
    torch.set_num_threads(2)
    two = objective(problem, parameters, "native")(theta)
    assert one[0] == pytest.approx(two[0], rel=1e-13)
    assert np.allclose(one[1], two[1], rtol=1e-11, atol=1e-13 * np.abs(one[1]).max())
    some = np.array([4, 1])
    compare(problem.take(some), parameters.take(some), parameters.take_vector(theta, some), ("float64",))


def test_local_columns_alone() -> None:
    problem, parameters, theta = problem_of(model_of(UNKNOWNS), some_data(("x", "z"), 1, 7, 0.3), 0.1, 3, blend=0.0)
    found = []
    for engine in (torch_engine(problem, parameters), native_engine(problem, parameters)):
        path = engine.plan(theta)
        scale = np.ones(problem.seen.shape)
        found.append(engine.jacobian(theta, path, engine.moments(theta, path), scale, only_local=True))
    graph, ours = found
    assert graph.shared.shape == ours.shared.shape == (len(ours.owner), 0)
    assert float((graph.local - ours.local).abs().max()) <= 1e-12 * float(graph.local.abs().max())


def test_predictions_where_nothing_was_measured() -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(2), 0.1, 2, blend=0.0)
    graph, ours = (predicted(make(problem, parameters), theta) for make in (torch_engine, native_engine))
    assert np.allclose(graph.mean, ours.mean, rtol=1e-12, atol=1e-13)
    assert np.allclose(graph.before, ours.before, rtol=1e-12, atol=1e-13)


def test_a_search_draws_fewer_starts_only_in_the_torch_graph() -> None:
    problem, parameters, _ = problem_of(model_of(LINEAR), some_data(("x", "before"), 0, 1, 0.4), 0.2, 0, blend=0.0)
    assert patience_of("normal", native_engine(problem, parameters)) == PATIENCE["normal"]
    assert patience_of("normal", torch_engine(problem, parameters)).draws < PATIENCE["normal"].draws
