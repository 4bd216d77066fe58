"""The filter engine against an independent Kalman filter, differences, and smoothing by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from gbspec.arrays import Array
from gbspec.training.engines import FilterEngine
from gbspec.training.engines.filter.layout import At
from gbspec.training.engines.filter.recursion import Moment
from gbspec.training.engines.filter.relinearised import iterated
from gbspec.training.engines.filter.smoother import smoothed
from tests.filter.conftest import BENT, LINEAR, WITH_NETWORK, engine_of, table


def reference(engine: FilterEngine, vector: Array) -> tuple[float, Array]:
    """The negative log likelihood of `LINEAR`, and the joint Gaussian's smoothed means at the rows of trajectory 0.

    By van Loan's matrix exponential, one trajectory and one row after the other, all channels of a row together.
    """
    packed, total = engine.problem.packed, 0.0
    theta, s, r = 1.0, 0.3, 0.4
    f, d = np.array([[-theta, 0.5], [-0.3, -theta]]), np.diag([s**2, r**2])
    c, noise = np.array([[1.0, 0.0], [-0.2, 1.0]]), np.array([0.1, np.exp(vector[-1])]) ** 2
    means = []
    for i in range(packed.trajectories):
        m, p = engine.parameters.start_value[i].copy(), np.diag(engine.start_variance[i])
        rows = np.flatnonzero(packed.row_trajectory == i)
        at = 0
        for row in rows[np.argsort(packed.row_index[rows])]:
            for step in range(at, packed.row_step[row]):
                h, u = packed.h[step, i], packed.inputs[step, i, 0, 0]
                big = expm(h * np.block([[-f, d], [np.zeros((2, 2)), f.T]]))
                a = big[2:, 2:].T
                b = np.array([0.0, theta * u])
                m, p = a @ m + np.linalg.solve(f, (a - np.eye(2)) @ b), a @ p @ a.T + a @ big[:2, 2:]
            at = packed.row_step[row]
            seen = np.flatnonzero(engine.problem.seen[row])
            e = packed.values[row, seen] - c[seen] @ m
            v = c[seen] @ p @ c[seen].T + np.diag(noise[seen])
            total += 0.5 * (e @ np.linalg.solve(v, e) + np.linalg.slogdet(2 * np.pi * v)[1])
            k = p @ c[seen].T @ np.linalg.inv(v)
            m, p = m + k @ e, p - k @ v @ k.T
            means.append(m)
    return float(total), np.array(means)


def test_linear_models_have_the_likelihood_of_an_independent_filter(tmp_path: Path) -> None:
    engine, vector = engine_of(tmp_path, LINEAR, table("X y"))
    assert engine.exact is not None
    found = engine.filtered(vector)
    total, means = reference(engine, vector)
    assert found.value == pytest.approx(total, rel=1e-10)
    after = engine.row_states(found)[1]
    packed = engine.problem.packed
    order = np.lexsort((packed.row_index, packed.row_trajectory))
    assert np.allclose(after[order], means, atol=1e-9)


def test_steps_of_the_solver_approach_the_exact_moments_with_order_four(tmp_path: Path) -> None:
    driven = LINEAR.replace("+ 0.5*V", "+ 0.5*V + 0.1*t")  # where nothing varied in a step, any step would be one
    exact, vector = engine_of(tmp_path, driven, table("X y"))
    errors = []
    for step in (0.1, 0.05, 0.01):
        engine, _ = engine_of(tmp_path, driven, table("X y"), max_step=step)
        stepping = FilterEngine(engine.problem, engine.parameters, engine.start_variance)
        stepping.__dict__["exact"] = None
        errors.append(abs(stepping.value(vector) - exact.value(vector)))
    assert errors[1] < errors[0] / 8
    assert errors[2] < 1e-8


def test_a_stiff_linear_model_is_solved_exactly(tmp_path: Path) -> None:
    stiff = LINEAR.replace("X' = -theta*X", "X' = -4e4*X").replace("observe X noise normal(0.1)", "observe X")
    engine, vector = engine_of(tmp_path, stiff, table("X y"))
    found = engine.filtered(vector)
    assert found.finite
    # The fast state has its stationary variance at every row.
    assert np.allclose(found.end_cov[4:, 0, 0], 0.3**2 / 8e4, rtol=1e-2)


@pytest.mark.parametrize("text", [LINEAR, BENT, WITH_NETWORK], ids=["linear", "bent", "network"])
def test_the_gradient_agrees_with_differences(tmp_path: Path, text: str) -> None:
    engine, vector = engine_of(tmp_path, text, table("X y" if text is LINEAR else "X V y", rows=8))
    rng = np.random.default_rng(1)
    vector = vector + 0.05 * rng.standard_normal(len(vector))
    information = engine.information(vector)
    for _ in range(3):
        direction, h = rng.standard_normal(len(vector)) * engine.layout.free, 1e-5
        change = (engine.value(vector + h * direction) - engine.value(vector - h * direction)) / (2 * h)
        assert information.gradient @ direction == pytest.approx(change, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("text", [LINEAR, BENT], ids=["linear", "bent"])
def test_the_information_is_that_of_differences(tmp_path: Path, text: str) -> None:
    engine, vector = engine_of(tmp_path, text, table("X y" if text is LINEAR else "X V y", rows=8))
    free, h = np.flatnonzero(engine.layout.free), 1e-5
    found, seen, slopes = engine.filtered(vector), engine.problem.valued, []
    for place in free:
        step = h * np.eye(len(vector))[place]
        up, down = engine.filtered(vector + step), engine.filtered(vector - step)
        slopes.append([(getattr(up, n)[seen] - getattr(down, n)[seen]) / (2 * h) for n in ("error", "variance")])
    error, variance = (np.array([pair[i] for pair in slopes]) for i in (0, 1))
    v = found.variance[seen]
    expected = (error / v) @ error.T + 0.5 * (variance / v**2) @ variance.T
    matrix = engine.information(vector, found).matrix[np.ix_(free, free)]
    assert np.allclose(matrix, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_without_disturbances_predictions_are_those_of_whole_solutions(tmp_path: Path) -> None:
    text = BENT.replace("learn s = 0.3 in [0, 5]", "const s = 0").replace("learn r = 0.4 in [0, 5]", "const r = 0")
    engine, vector = engine_of(
        tmp_path, text.replace("initial X learn", "initial X learn\ninitial V = 1"), table("X V y")
    )
    found = engine.filtered(vector)
    whole = engine.filtered(vector, seen=np.zeros_like(engine.problem.valued))
    assert np.allclose(found.mean, whole.mean, rtol=1e-9)
    errors = np.where(engine.problem.valued, engine.noise.value - whole.mean, 0.0)
    assert np.allclose(np.where(engine.problem.valued, found.error, 0.0), errors, rtol=1e-9, atol=1e-10)


def test_smoothing_begins_with_the_filter_and_reduces_variances(tmp_path: Path) -> None:
    engine, vector = engine_of(tmp_path, LINEAR, table("X y", rows=6, trajectories=1))
    found = engine.filtered(vector)
    mean, cov, *_ = smoothed(found, engine.legs)
    assert np.allclose(mean[-1], found.post_mean[-1])
    assert (np.diagonal(cov, axis1=1, axis2=2) <= np.diagonal(found.post_cov, axis1=1, axis2=2) + 1e-12).all()


def test_smoothed_means_maximise_the_joint_density(tmp_path: Path) -> None:
    engine, vector = engine_of(tmp_path, LINEAR, table("X y", rows=5, trajectories=1))
    found = engine.filtered(vector)
    mean, *_, start, _ = smoothed(found, engine.legs)
    # Least squares of the whole path: starts, disturbances and measurements, each over its standard deviation.
    legs, n = len(mean), 2
    rows, right = [], []

    def add(coefficients: dict[int, Array], value: Array, covariance: Array) -> None:
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        line = np.zeros((len(value), n * (legs + 1)))
        for place, matrix in coefficients.items():
            line[:, place * n : place * n + n] = matrix
        rows.append(root @ line)
        right.append(root @ value)

    zero = Moment(np.zeros((legs, n)), np.zeros((legs, n, n)))
    flows = engine.flows(At.of(engine.layout, vector[:-1]), np.arange(legs), zero)
    add({0: np.eye(n)}, engine.parameters.start_value[0], np.diag(engine.start_variance[0]))
    c = np.array([[1.0, 0.0], [-0.2, 1.0]])
    noise = engine.noise.variances(vector[-1:])
    for leg in range(legs):
        q = flows.q[leg] + 1e-14 * np.eye(n)
        add({leg: -flows.a[leg], leg + 1: np.eye(n)}, flows.mean[leg], q)
        row = engine.legs.row[leg]
        seen = np.flatnonzero(engine.problem.seen[row]) if row >= 0 else []
        if len(seen):
            add({leg + 1: c[seen]}, engine.problem.packed.values[row, seen], np.diag(noise[row, seen]))
    whole = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0].reshape(-1, n)
    assert np.allclose(mean, whole[1:], atol=1e-5)
    assert np.allclose(start[0], whole[0], atol=1e-5)


def test_the_iterated_smoother_rests_where_its_linearisation_is(tmp_path: Path) -> None:
    engine, vector = engine_of(tmp_path, BENT, table("X V y", rows=12))
    seen = engine.problem.valued.copy()
    seen[3:8] = False
    found = engine.filtered(vector, seen)
    mean, cov, start, start_cov = iterated(engine, vector, found)
    again = smoothed(engine.linearised(vector, (start, start_cov, mean, cov, found.shares), seen), engine.legs)[0]
    assert np.abs(again - mean).max() < 1e-3 * engine.scale.max()
    assert np.abs(mean - smoothed(found, engine.legs)[0]).max() > 1e-3


@pytest.mark.parametrize("drift", ["-k*x", "-k*x^2"], ids=["exact", "stepped"])
def test_doses_and_constants_per_trajectory_have_exact_gradients(tmp_path: Path, drift: str) -> None:
    text = (
        f"model m\ntime t\nstate x in [0, 5] = 1\nlearn k = 0.7 in [0.1, 3] per trajectory\nlearn f = 0.8 in [0.1, 1]\n"
        f"learn s = 0.2 in [0, 2]\nx' = {drift}\ndose x times f\ndiffusion x = s\nobserve x\n"
    )
    lines = ["trajectory,t,x,dose_x"]
    for k in range(2):
        lines += [f"{k},0,1.1,", f"{k},0.5,0.{7 + k},", f"{k},0.8,,{1 + k}", f"{k},1.2,1.3,", f"{k},2,0.9,"]
    engine, vector = engine_of(tmp_path, text, "\n".join(lines) + "\n")
    assert (engine.exact is None) == ("^" in drift)
    information, h = engine.information(vector), 1e-5
    for place in np.flatnonzero(engine.layout.free):
        step = np.zeros(len(vector))
        step[place] = h
        change = (engine.value(vector + step) - engine.value(vector - step)) / (2 * h)
        assert information.gradient[place] == pytest.approx(change, rel=1e-5, abs=1e-5)
