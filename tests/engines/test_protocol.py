"""Every engine answers the questions of the Protocol alike; the residual has one definition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.ir.residual import LOG_FLOOR, residuals, slopes
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.engines.engine import Engine, Lack, UnableError, taken
from gbspec.training.engines.objective import half_squares, linearise, predicted, residual_table, residual_vector
from gbspec.training.engines.torch.unroll import graph_residuals
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, urp_data
from tests.training.reference import kernel_residuals, whole_jacobian

Given = tuple[Problem, Parameters, Array]
Make = Callable[[Problem, Parameters], Engine]
ENGINES: dict[str, Make] = {"torch": torch_engine, "native": native_engine}
LOGARITHMIC = URP.replace("observe x1", "observe x1 noise lognormal(0.1)")
COUNTS = URP.replace("observe x1", "observe x1 noise negative_binomial(4)").replace(
    "observe x2", "observe x2 noise poisson"
)


pytestmark = pytest.mark.usefixtures("quick_fits")


@pytest.fixture(scope="module", params=["everything", "reactor", "logarithmic", "counts"])
def given(request: pytest.FixtureRequest) -> Given:
    if request.param == "everything":
        return problem_of(model_of(EVERYTHING), everything_data(), 0.13, blend=0.3)
    text = {"reactor": URP, "logarithmic": LOGARITHMIC, "counts": COUNTS}[request.param]
    return problem_of(model_of(text), urp_data(4, 2.0, 6), 0.2, blend=0.3)


@pytest.mark.parametrize("name", ENGINES)
def test_moments_and_their_derivatives_agree_with_differences(name: str, given: Given) -> None:
    problem, parameters, theta = given
    engine = ENGINES[name](problem, parameters)
    path, rng = engine.plan(theta), np.random.default_rng(0)
    moments = engine.moments(theta, path)
    assert moments.finite and moments.log_sd is None
    direction, h = rng.standard_normal(len(theta)), 1e-6
    ahead, behind = (engine.moments(theta + s * h * direction, engine.plan(theta + s * h * direction)) for s in (1, -1))
    change = ((ahead.mean - behind.mean) / (2 * h))[problem.seen]
    scale = rng.uniform(0.5, 2.0, problem.seen.shape)
    found = whole_jacobian(engine.jacobian(theta, path, moments, scale), parameters).numpy()
    assert np.allclose(found @ direction, scale[problem.seen] * change, rtol=1e-6, atol=1e-6)
    cotangent = np.where(problem.seen, rng.standard_normal(problem.seen.shape), 0.0)
    pulled = engine.pullback(theta, path, cotangent * scale)
    expected = cotangent[problem.seen] @ found
    assert np.allclose(pulled, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("name", ENGINES)
def test_pullbacks_of_groups_add_up(name: str, given: Given) -> None:
    problem, parameters, theta = given
    engine = ENGINES[name](problem, parameters)
    path = engine.plan(theta)
    cotangent = np.where(problem.seen, np.random.default_rng(1).standard_normal(problem.seen.shape), 0.0)
    whole = engine.pullback(theta, path, cotangent)
    by = np.arange(problem.packed.trajectories) % 2
    groups = engine.pullback(theta, path, cotangent, by)
    assert groups.shape == (2, parameters.size)
    assert np.allclose(groups.sum(0), whole, rtol=1e-10, atol=1e-12 * np.abs(whole).max())
    blocks = groups[:, parameters.n_shared :].reshape(2, parameters.trajectories, parameters.n_local)
    assert np.abs(blocks[0, by == 1]).max() == np.abs(blocks[1, by == 0]).max() == 0.0


@pytest.mark.parametrize("name", ENGINES)
def test_the_gradient_is_the_pullback_of_the_residuals(name: str, given: Given) -> None:
    problem, parameters, theta = given
    engine = ENGINES[name](problem, parameters)
    path = engine.plan(theta)
    value, gradient = half_squares(engine, theta)
    table, mean = residual_table(engine, theta), engine.moments(theta, path).mean
    scaling = problem.scaling
    of_means = table * slopes(mean, problem.measured, problem.factor, scaling.log, sizes=scaling.sizes)
    assert value == pytest.approx(0.5 * float((table**2).sum()), rel=1e-12)
    expected = engine.pullback(theta, path, of_means)
    assert np.allclose(gradient, expected, rtol=1e-10, atol=1e-12 * np.abs(expected).max())
    some = np.array([2, 0])
    part = taken(engine, some)
    alone, own = half_squares(part, parameters.take_vector(theta, some))
    among = half_squares(engine, theta, some)
    assert among[0] == pytest.approx(alone, rel=1e-12)
    assert np.allclose(parameters.take_vector(among[1], some), own, rtol=1e-10, atol=1e-13)


def test_second_derivatives_of_the_graph_agree_with_differences(given: Given) -> None:
    problem, parameters, theta = given
    engine, rng = torch_engine(problem, parameters), np.random.default_rng(2)
    path = engine.plan(theta)
    direction = rng.standard_normal(len(theta))
    cotangent = np.where(problem.seen, rng.standard_normal(problem.seen.shape), 0.0)
    found = engine.second(theta, path, direction, cotangent)
    h = 1e-5
    ahead, behind = (
        engine.pullback(at, engine.plan(at), cotangent) for at in (theta + h * direction, theta - h * direction)
    )
    # the Hessian is symmetric: its product with the direction is the change of the pullback along it
    assert np.allclose(found, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-6 * np.abs(found).max())


def test_an_engine_says_by_a_typed_reason_what_it_cannot_do(given: Given) -> None:
    problem, parameters, theta = given
    engine = native_engine(problem, parameters)
    with pytest.raises(UnableError, match="no second derivatives") as caught:
        engine.second(theta, engine.plan(theta), theta, problem.factor)
    assert caught.value.unable.lack is Lack.SECOND


def test_engines_agree(given: Given) -> None:
    problem, parameters, theta = given
    one, other = (make(problem, parameters) for make in ENGINES.values())
    a, b = predicted(one, theta), predicted(other, theta)
    for of_torch, of_kernel in zip(
        (a.mean, a.before, a.after, a.initial), (b.mean, b.before, b.after, b.initial), strict=True
    ):
        assert np.allclose(of_torch, of_kernel, rtol=1e-12, atol=1e-12)
    assert np.allclose(residual_vector(one, theta), residual_vector(other, theta), rtol=1e-11, atol=1e-12)
    first, second = linearise(one, theta), linearise(other, theta)
    assert torch.allclose(first.shared, second.shared, rtol=1e-9, atol=1e-11)


# ---------------------------------------------------------------------- the residual
def tables(rows: int = 200) -> tuple[Array, Array, Array, Array]:
    """Predictions on both sides of zero and of the floor, measurements, factors (some 0), and which are logarithmic."""
    rng = np.random.default_rng(5)
    measured = rng.uniform(0.1, 3.0, (rows, 2))
    predicted = measured * rng.choice([-2.0, -0.1, 0.0, 1e-4, 1e-3, 0.5, 1.0, 4.0], (rows, 2))
    factor = rng.uniform(0.5, 2.0, (rows, 2)) * (rng.random((rows, 2)) > 0.2)
    return predicted, measured, factor, np.array([False, True])


def test_the_residual_is_what_its_formula_says() -> None:
    p, y, f, log = tables()
    found = residuals(p, y, f, log)
    assert np.allclose(found[:, 0], f[:, 0] * (p[:, 0] - y[:, 0]), rtol=1e-15)
    ratio = p[:, 1] / y[:, 1]
    above = ratio >= LOG_FLOOR
    assert above.any() and not above.all()
    assert np.allclose(found[above, 1], f[above, 1] * np.log(ratio[above]), rtol=1e-14)
    tangent = np.log(LOG_FLOOR) + (ratio[~above] - LOG_FLOOR) / LOG_FLOOR
    assert np.allclose(found[~above, 1], f[~above, 1] * tangent, rtol=1e-14)
    assert (found[f == 0] == 0).all()
    p[f == 0] = np.nan
    assert np.isfinite(residuals(p, y, f, log)).all(), "what was not measured does not matter"


@pytest.mark.parametrize("sizes", [None, np.array([4.0, 0.0]), np.array([np.inf, 0.0])])
def test_the_graph_has_the_same_residuals_and_slopes(sizes: Array | None) -> None:
    p, y, f, log = tables()
    vector = torch.from_numpy(p).requires_grad_()
    out = residuals(vector, torch.from_numpy(y), torch.from_numpy(f), log, torch, sizes=sizes)
    assert np.allclose(out.detach().numpy(), residuals(p, y, f, log, sizes=sizes), rtol=1e-14, atol=1e-16)
    (slope,) = torch.autograd.grad(out.sum(), vector)
    away = (np.abs(p / y - LOG_FLOOR) > 1e-9) & ((p != 0) | (sizes is None))
    assert np.allclose(slope.numpy()[away], slopes(p, y, f, log, sizes=sizes)[away], rtol=1e-12, atol=0)


@pytest.mark.parametrize("size", [0.5, 4.0, np.inf])
def test_residuals_of_counts_have_the_noise_of_one(size: float) -> None:
    rng, mean = np.random.default_rng(0), np.array([5.0, 50.0, 500.0])
    each = np.ones((40_000, 1)) if np.isinf(size) else rng.gamma(size, 1 / size, (40_000, 1))
    drawn = rng.poisson(mean * each)
    log, sizes = np.zeros(3, dtype=bool), np.full(3, size)
    found = residuals(mean, drawn.astype(np.float64), np.ones(3), log, sizes=sizes)
    assert found.std(axis=0) == pytest.approx(np.ones(3), abs=0.1 if size > 1 else 0.5)
    assert (
        np.diff(residuals(np.linspace(-50, 50, 999)[:, None], 20.0, np.ones(1), log[:1], sizes=sizes[:1])[:, 0]).min()
        > 0
    )


def test_the_kernel_replaces_a_measured_zero_alike() -> None:
    problem, parameters, theta = problem_of(model_of(LOGARITHMIC), urp_data(4, 2.0, 6), 0.2, blend=0.3)
    values = problem.packed.values.copy()
    values[:6] = np.where(np.isfinite(values[:6]), np.array([[0.0], [1e-310], [-1e-5], [1e-290], [0.0], [2.0]]), np.nan)
    zeros = replace(problem, packed=replace(problem.packed, values=values))
    assert zeros.seen[[0, 4], 0].any(), "the first channel is logarithmic"
    engine = native_engine(zeros, parameters)
    assert np.allclose(kernel_residuals(engine, theta), residual_table(engine, theta), rtol=1e-12, atol=1e-13)


def test_the_kernel_has_the_same_residuals(given: Given) -> None:
    problem, parameters, theta = given
    engine = native_engine(problem, parameters)
    path = engine.plan(theta)
    fused = kernel_residuals(engine, theta)
    assert np.allclose(fused, residual_table(engine, theta), rtol=1e-12, atol=1e-13)
    graph = graph_residuals(problem, torch.from_numpy(engine.moments(theta, path).mean))
    assert np.allclose(fused, graph.numpy(), rtol=1e-12, atol=1e-13)
