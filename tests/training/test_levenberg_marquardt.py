"""A damped step of Levenberg-Marquardt, corrected along a curved valley without another factorisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.data.trajectories import Trajectories
from gbspec.training.engines.objective import linearise
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.optimise.levenberg_marquardt import (
    LevenbergMarquardt,
    LevenbergOptions,
    _bend,
    _Fit,
    _followed,
    _searched,
    evidence,
)
from gbspec.training.optimise.normal_equations import NormalEquations

from .conftest import URP, model_of, problem_of, trajectory, urp_data


@pytest.fixture(scope="module")
def stage() -> tuple[LevenbergMarquardt, Array]:
    """A stage, and a vector that it has brought into the valley."""
    problem, parameters, theta = problem_of(model_of(URP), urp_data(8, 4.0, 1), 0.2)
    stage = LevenbergMarquardt("teacher forcing", 26, lambda _: TorchEngine(problem, parameters), LevenbergOptions())
    state = stage.begin(theta)
    for i in range(26):
        state = stage.step(state, i).state
    return stage, state["theta"]


def fit_at(stage: LevenbergMarquardt, theta: Array) -> _Fit:
    engine = stage.engine_at(0)
    system = linearise(engine, theta)
    return _Fit(engine, system, theta, stage.threshold(system.residuals.numpy()), 0.0)


def test_corrections_bring_a_long_step_to_where_the_linear_model_predicted(
    stage: tuple[LevenbergMarquardt, Array],
) -> None:
    fit = fit_at(*stage)
    gains = []
    for damping in (1e-1, 1e-2, 1e-3, 1e-4):
        step = fit.step(damping)
        plain, (move, after) = fit.solved(step), _followed(fit, step, damping)
        assert after.value <= plain.value
        assert after.value == fit.solved(move).value
        bend = _bend(fit, step, damping)
        if bend is not None:
            assert after.value <= max(fit.solved(step + bend).value, plain.value)
            gains.append(plain.value / after.value)
    assert max(gains) > 3, "the straight step leaves the valley"


def test_outliers_are_limited_in_channels_of_which_only_a_share_counts() -> None:
    problem, parameters, theta = problem_of(model_of(URP), urp_data(4, 4.0, 1), 0.2)
    share, scaling = np.array([0.04, 1.0]), problem.scaling
    weighed = replace(scaling, row_scale=scaling.row_scale / np.sqrt(share), share=share)
    fits = []
    for each in (problem, replace(problem, scaling=weighed)):
        engine = TorchEngine(each, parameters)
        system = linearise(engine, theta)
        delta = 0.5 * float(np.median(np.abs(each.of_noise(system.residuals.numpy()))))
        fits.append(_Fit(engine, system, theta, delta, 0.0))
    plain, other = fits
    assert plain.delta == pytest.approx(other.delta)
    weights = plain.equations.root[: plain.count]
    assert weights.min() < 0.9 and np.allclose(other.equations.root[: other.count], weights)


def test_a_jacobian_serves_until_no_damping_lowers_the_objective_further(
    stage: tuple[LevenbergMarquardt, Array],
) -> None:
    """From far too much damping and from far too little it comes to a decrease."""
    fit = fit_at(*stage)
    for damping in (1e3, 1e-9):
        found = _searched(fit, damping)
        assert 0 < found.gain <= 1 and found.after.value < fit.start.value
        assert found.damping < 1e3 and found.damping > 1e-9


def test_equations_without_a_solution_are_no_step(
    stage: tuple[LevenbergMarquardt, Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = fit_at(*stage)

    def singular(*_: object) -> Array:
        raise np.linalg.LinAlgError

    monkeypatch.setattr(NormalEquations, "step", singular)
    monkeypatch.setattr(NormalEquations, "respond", singular)
    found = _searched(fit, 1.0)
    assert found.gain == 0 and not found.after.value < fit.start.value


def test_the_whole_step_ends_where_its_own_error_begins(stage: tuple[LevenbergMarquardt, Array]) -> None:
    one, theta = stage
    asked: list[Array] = []

    def enough(at: Array, residuals: Array) -> float:
        asked.append(at)
        return float("inf")

    options = LevenbergOptions(enough=enough)
    outcome = LevenbergMarquardt("t", 1, one.engine_at, options)
    done = outcome.step(outcome.begin(theta), 0)
    assert done.done and np.array_equal(asked[-1], done.state["theta"])


def with_evidence(spread: float) -> tuple[LevenbergMarquardt, Array]:
    """Whole solutions of noisy data under the ridge of the evidence, with weights where the noise has put them."""
    problem, parameters, theta = problem_of(model_of(URP), urp_data(4, 2.0, 1, 0.05), 0.2)
    options = LevenbergOptions(ridge=1e-3, evidence=True, tolerance=1e-12, spread=spread)
    return LevenbergMarquardt("any", 6, lambda _: TorchEngine(problem, parameters), options), theta


@pytest.mark.parametrize(("spread", "ends"), [(0.0, False), (1e6, True)])
def test_a_fit_whose_predictions_no_longer_move_rests(spread: float, ends: bool) -> None:
    """Its objective still falls then, while the prior shrinks weights that the data leave open."""
    stage, theta = with_evidence(spread)
    first = stage.step(stage.begin(theta), 0)
    assert not first.done
    assert stage.step(first.state, 1).done is ends


def test_the_ridge_of_the_evidence_depends_on_the_vector_alone() -> None:
    """With other random vectors in each iteration it would never settle, nor would the fit rest."""
    stage, theta = with_evidence(0.0)
    state = stage.begin(theta)
    assert stage.step(state, 0).state["ridge"] == stage.step(state, 5).state["ridge"] != state["ridge"]


def test_the_ridge_of_vanishing_weights_is_finite() -> None:
    """Where data show no function the evidence shrinks weights to nothing, by the inverse of their square."""
    stage, theta = with_evidence(0.0)
    fit, engine = fit_at(stage, theta), stage.engine_at(0)
    nothing = theta.copy()
    nothing[: engine.parameters.n_weights] *= 1e-160
    ridge = 1e-3
    for _ in range(400):
        ridge, _ = evidence(engine.problem, fit.equations, fit.measured(fit.start), fit.delta, nothing, ridge, 0)
    assert np.isfinite(ridge)
    fit.equations.ridge = ridge
    assert np.isfinite(fit.equations.step(1.0)).all()


def test_a_constant_at_its_bound_comes_back_where_the_sum_of_squares_falls_inwards() -> None:
    text = (
        "model m\nstate x in [0, 3] = 1\nlearn k = 0.5 in [0, 1]\nlearn c = 0.1 in [0, 2]\n"
        "x' = c - k*x\nobserve x noise normal(0.05)\n"
    )
    times = np.linspace(0.0, 10.0, 21)
    values = 0.2 / 0.3 + (1 - 0.2 / 0.3) * np.exp(-0.3 * times)
    values += 0.02 * np.random.default_rng(0).standard_normal(21)
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    problem, parameters, theta = problem_of(model_of(text), data, 0.5, blend=0.0)
    parameters = replace(parameters, start_value=np.ones((1, 1)))
    options, found = LevenbergOptions(robust=False, tolerance=1e-9, damping=1e-2), []
    for start in (theta[0], -np.log(1e-14) / 3):
        stage = LevenbergMarquardt("least squares", 60, lambda _: TorchEngine(problem, parameters), options)
        theta[0] = start
        state = stage.begin(theta.copy())
        for i in range(60):
            outcome = stage.step(state, i)
            state = outcome.state
            if outcome.done:
                break
        found.append(outcome.loss)
    assert found[1] == pytest.approx(found[0], rel=1e-6)
