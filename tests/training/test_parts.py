"""Bounds, least-squares steps, curves, elimination and initial states, each on its own."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.ir.model import Learnable, Range
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.optimise.normal_equations import NormalEquations, huber, huber_each, huber_weights
from gbspec.training.options import TrainOptions
from gbspec.training.problem.bounds import Bijection, Bijections
from gbspec.training.problem.packing import pack
from gbspec.training.problem.scaling import scaling_of
from gbspec.training.recipe.context import build_context
from gbspec.training.recipe.preparation import prepare
from gbspec.training.recipe.stages import mean_loss
from gbspec.training.starts.initial_states import refit_starts
from gbspec.training.starts.splines import CurveKind, curve_of, fit_curves, smoothed
from gbspec.training.starts.warm_start import eliminate
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, trajectory, urp_data
from tests.training.reference import linearise, solve, whole_jacobian

RANGES = [Range(0, 50), Range(low=0.0), Range(high=3.0), Range(), Range(-2, -1), Range(1e-5, 1e5), Range(-1e3, -1e-2)]


def bijections_of(range_: Range, start: float) -> Bijections:
    return Bijections.of((Learnable("k", start=start, range=range_),))


def inside(range_: Range) -> float:
    return -1.5 if range_.high < 0 else 1.0


@given(st.sampled_from(RANGES), st.floats(-30, 30), st.booleans())
def test_bounds_hold_whatever_the_optimiser_does(range_: Range, u: float, at_the_bound: bool) -> None:
    start = range_.low if at_the_bound and np.isfinite(range_.low) else inside(range_)
    value = float(bijections_of(range_, start).to_natural(torch.tensor([u], dtype=torch.float64))[0])
    assert range_.low <= value <= range_.high


@given(st.sampled_from(RANGES), st.floats(-1.5, 1.5))
def test_bijections_invert_and_differentiate(range_: Range, u: float) -> None:
    bijections = bijections_of(range_, inside(range_))

    def natural(x: float) -> float:
        return float(bijections.to_natural(torch.tensor([x], dtype=torch.float64))[0])

    assert bijections.from_natural(np.array([natural(u)]))[0] == pytest.approx(u, abs=1e-7)
    slope = (natural(u + 1e-6) - natural(u - 1e-6)) / 2e-6
    assert bijections.derivative(np.array([u]))[0] == pytest.approx(slope, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize(
    ("range_", "start"),
    [
        (Range(1e-5, 1e5), 0.03),
        (Range(1e-5, 1e5), 1.0001e-5),
        (Range(0, 1e5), 0.03),
        (Range(0, 1e9), 1e-3),
        (Range(0, 1), 1 - 1e-9),
        (Range(-1e5, 1e5), 0.03),
        (Range(-1e5, -1e-5), -0.03),
        (Range(low=0), 0.03),
        (Range(low=1000), 1000.001),
        (Range(high=5), 4.99999),
        (Range(2, 3), 2.0001),
        (Range(), -7.0),
    ],
)
def test_a_start_is_not_moved(range_: Range, start: float) -> None:
    bijections = bijections_of(range_, start)
    u = bijections.from_natural(np.array([start]))
    rounding = 1e-15 * (range_.high - range_.low) if range_.low * range_.high < 0 else 0.0
    value = float(bijections.to_natural(torch.from_numpy(u))[0])
    assert value == pytest.approx(start, rel=1e-12, abs=rounding)
    assert bijections.derivative(u)[0] != 0


@pytest.mark.parametrize(
    ("range_", "start"),
    [
        (Range(0, 10), 0.0),
        (Range(0, 10), 10.0),
        (Range(1e-3, 1e3), 1e-3),
        (Range(1e-3, 1e3), 1e3),
        (Range(low=0), 0.0),
        (Range(high=2), 2.0),
    ],
)
def test_a_start_on_its_bound_is_off_it_by_rounding_and_can_leave(range_: Range, start: float) -> None:
    bijections = bijections_of(range_, start)
    u = bijections.from_natural(np.array([start]))
    value = float(bijections.to_natural(torch.from_numpy(u))[0])
    assert range_.low <= value <= range_.high and value == pytest.approx(start, rel=1e-9, abs=1e-9)
    slope = abs(bijections.derivative(u)[0])
    assert slope > 1e-7 * min(abs(start) or 1.0, 1.0)
    here, damping = abs(1.0 - value), 1e-2
    for _ in range(60):  # damped steps towards 1
        slope = bijections.derivative(u)[0]
        trial = u + slope * (1.0 - value) / (slope**2 + damping)
        there = float(bijections.to_natural(torch.from_numpy(trial))[0])
        better = abs(1.0 - there) < here
        u, value, here = (trial, there, abs(1.0 - there)) if better else (u, value, here)
        damping *= 0.2 if better else 4.0
    assert value == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize(
    ("range_", "logarithmic"),
    [
        (Range(1, 99), False),
        (Range(1, 100), True),
        (Range(-5, -0.05), True),
        (Range(0, 1e6), False),
        (Range(-1, 1e6), False),
    ],
)
def test_ranges_of_two_decades_have_a_logarithmic_scale(range_: Range, logarithmic: bool) -> None:
    assert Bijection.of(Learnable("k", start=range_.low, range=range_)).logarithmic is logarithmic


@pytest.mark.parametrize("ridge", [0.0, 0.02])
@pytest.mark.parametrize("many", [False, True])
def test_steps_solve_the_damped_normal_equations(ridge: float, many: bool) -> None:
    """Both forms (dual with few residuals, primal with many) against the dense equations."""
    model = model_of(URP.replace("mlp(12, 12)", "mlp(3)")) if many else model_of(URP)
    problem, parameters, theta = problem_of(model, urp_data(6, 4.0, 1), 0.2)
    system = linearise(problem, parameters, theta)
    residuals = system.residuals.numpy()
    weights = huber_weights(residuals, 0.2)
    J = whole_jacobian(system, parameters).numpy() * np.sqrt(weights)[:, None]
    equations = NormalEquations(system, parameters, weights, ridge, theta)
    assert equations.dual is not many
    penalised = np.arange(parameters.size) < parameters.n_weights
    damping = 0.05
    matrix = J.T @ J + damping * np.eye(parameters.size) + ridge * np.diag(penalised)
    expected = -np.linalg.solve(matrix, J.T @ (residuals * np.sqrt(weights)) + ridge * penalised * theta)
    assert np.allclose(equations.step(damping), expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    vector = np.random.default_rng(0).standard_normal(parameters.size)
    solved = np.linalg.solve(matrix, vector)
    assert np.allclose(equations.invert(vector, damping), solved, rtol=1e-6, atol=1e-8 * np.abs(solved).max())
    freedom = float(np.trace(J @ np.linalg.solve(matrix, J.T)))
    assert equations.degrees_of_freedom(damping, 0) == pytest.approx(freedom, rel=0.2)


def test_huber_is_quadratic_then_linear() -> None:
    r = np.array([0.05, -3.0])
    assert huber(r, 0.1) == pytest.approx(0.5 * 0.05**2 + 0.1 * (3 - 0.05))
    assert huber(np.array([np.nan]), 0.1) == np.inf
    assert huber_weights(r, 0.1) == pytest.approx([1.0, 0.1 / 3])


def test_residuals_of_a_solution_that_runs_away_are_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert huber(np.array([1e200, 1.0]), 0.5) == pytest.approx(5e199)
        assert huber(np.array([1e200, 1.0]), np.inf) == np.inf
        assert mean_loss(np.array([1e200, 1.0])) == np.inf
        assert huber_each(np.array([1e200, np.inf, 0.1]), 0.5) == pytest.approx([5e199, np.inf, 0.005])


@pytest.mark.parametrize("count", [1, 2, 3, 5, 40])
@pytest.mark.parametrize("kind", ["interpolating", "smooth", "pieces"])
def test_curves_of_any_number_of_points(count: int, kind: CurveKind) -> None:
    model = model_of(URP)
    times = np.linspace(1.0, 2.0, count)
    values = np.column_stack([np.sin(3 * times), np.full(count, 2.0)])
    data = Trajectories((trajectory("a", 0.0, times, values, [0.3]),), ("x1", "x2"))
    for curve in fit_curves(model, data, kind).items[0]:
        if count < 2:
            assert curve is None
            continue
        assert curve is not None
        assert np.isfinite(curve.extended(np.array([-5.0, 1.5, 50.0]))).all()
        assert np.isfinite(curve.slope(times)).all()


def test_monotone_data_get_a_monotone_curve() -> None:
    times = np.array([0.0, 1.0, 1.1, 5.0, 9.0])
    values = np.column_stack([np.array([0.0, 0.0, 1.0, 1.0, 1.0])] * 2)
    data = Trajectories((trajectory("a", 0.0, times, values, [0.3]),), ("x1", "x2"))
    curve = fit_curves(model_of(URP), data).items[0][0]
    assert curve is not None
    assert (np.diff(curve.value(np.linspace(0, 9, 200))) >= -1e-12).all()


def test_elimination_finds_constants_without_knowing_the_function() -> None:
    model = model_of(URP)
    context = build_context(model, load_module(model), urp_data(10, 6.0, 7), TrainOptions(), 0)
    bijections = Bijections.of(model.learnables)
    found = eliminate(model, context.module, context.points, bijections.from_natural(np.array([5.0, 1.0])))
    natural = bijections.to_natural(torch.from_numpy(found.constants)).numpy()
    assert natural == pytest.approx([11, 3], rel=0.05)


def test_outputs_are_scaled_by_what_the_slopes_ask_for() -> None:
    prepared = prepare(model_of(URP), load_module(model_of(URP)), urp_data(6, 4.0, 7), TrainOptions(), 0)
    scale = prepared.parameters.fixed["network.phi.output_scale"][0]
    assert 0.05 < scale < 1.0, "the rate varies by about 0.2"
    low, high = (prepared.parameters.fixed[f"network.phi.input_{end}"] for end in ("low", "high"))
    assert (low < high).all() and low[2] >= 0.2 and high[2] <= 0.5


def test_refitted_starts_never_fit_worse() -> None:
    problem, parameters, theta = problem_of(model_of(URP), urp_data(5, 3.0, 2), 0.1)
    before = solve(problem, parameters, theta)
    after = solve(problem, parameters, refit_starts(TorchEngine(problem, parameters), theta, 0))
    assert np.sum(after**2) < np.sum(before**2)
    moved = parameters.with_starts(theta, np.full((5, 2), 9.0))
    assert moved[parameters.n_shared] == 0.0, "a start that is given does not move"


@pytest.mark.parametrize("declared", [" in [0, 5]", ""])
def test_starts_that_nothing_measures_stay_in_their_declared_ranges(declared: str) -> None:
    """`x` falls, which a positive `y` cannot explain while the balances are wrong."""
    model = model_of(f"state x\nstate y{declared}\nlearn k = 1 in [0.5, 2]\nx' = k*y\ny' = -y\nobserve x\n")
    times = np.linspace(0.01, 2.0, 200)
    data = Trajectories((trajectory("1", 0.0, times, (1.0 - 3.0 * times)[:, None], []),), ("x",))
    problem, parameters, theta = problem_of(model, data, 0.1, blend=0.0)
    theta = parameters.with_starts(theta, np.full((1, 2), 0.1))
    found = refit_starts(TorchEngine(problem, parameters), theta, 0)
    start = parameters.starts(torch.from_numpy(found)).numpy()[0, 1]
    assert 0 <= start <= 5 if declared else start < -1


def test_stated_noise_sets_relative_weights() -> None:
    model = model_of(
        URP.replace("observe x1", "observe x1 noise normal(0.01)").replace("observe x2", "observe x2 noise normal(0.1)")
    )
    data = urp_data(4, 3.0, 2)
    scaling = scaling_of(model, pack(data, model, 0.1), data)
    assert scaling.channel[1] / scaling.channel[0] == pytest.approx(10)
    plain = scaling_of(model_of(URP), pack(data, model, 0.1), data)
    sds = [np.nanstd(np.concatenate([item.values[:, i] for item in data.items])) for i in range(2)]
    assert plain.channel == pytest.approx(sds)


def test_log_normal_residuals_are_of_logarithms() -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(), 0.2)
    assert problem.scaling.log.tolist() == [False, False, True]
    assert np.isfinite(solve(problem, parameters, theta)).all()


def test_rows_at_the_same_time_but_for_rounding_give_no_steep_curve() -> None:
    """Tables that are put together have 0.6 and 0.6000000000000001, with values that differ by the noise."""
    t = np.sort(np.concatenate([np.linspace(0, 3, 31), [0.6 + 2e-16, 1.2 + 3e-16]]))
    y = np.sin(t) + 0.05 * np.cos(40 * t + np.arange(len(t)))
    curve, smooth = curve_of(t, y), smoothed(t, y)
    assert curve is not None
    assert smooth is not None
    fine = np.linspace(0, 3, 200)
    assert np.abs(curve.slope(fine)).max() < 10
    assert np.abs(smooth.derivative()(fine)).max() < 3
