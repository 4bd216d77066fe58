"""Moments through nonlinear functions: against the normal distribution's own, and where functions have no value."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.training.engines.filter.sigma import Cloud, Varied, root, rule
from tests.filter.conftest import engine_of

QUADRATIC = """model quadratic
time t
state x in [0, 4] = 1
learn a = 0.4 in [0, 2]
learn s = 0.5 in [0, 2]
x' = 1 - a*x^2
initial x = 1
diffusion x = s
observe x noise normal(0.1)
observe y = x^2 noise normal(0.1)
"""


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_points_have_the_moments_of_the_normal_distribution(n: int) -> None:
    here = rule(n)
    assert (here.weights >= 0).all()
    assert here.weights.sum() == pytest.approx(1)
    assert np.allclose(here.weights @ here.points, 0)
    assert np.allclose(here.points.T @ (here.weights[:, None] * here.points), np.eye(n))


def test_quadratic_functions_have_their_exact_moments_and_linear_ones_no_remainder() -> None:
    rng = np.random.default_rng(0)
    half = rng.standard_normal((4, 2, 2))
    p, m = half @ half.swapaxes(1, 2), rng.standard_normal((4, 2))
    cloud = Cloud.of(Varied(m[:, :, None]), root(Varied(p), np.zeros(2)), np.ones(4))
    x, y = cloud.at.value[:, 0], cloud.at.value[:, 1]
    values = Varied(np.stack([x * x, 2 * x - y], axis=1))
    assert np.allclose(
        cloud.mean(values).value[:, :, 0], np.stack([m[:, 0] ** 2 + p[:, 0, 0], 2 * m[:, 0] - m[:, 1]], 1)
    )
    remaining = cloud.remaining(values).value
    assert np.allclose(remaining[:, 0, 0], 2 * p[:, 0, 0] ** 2)
    assert np.allclose(remaining[:, 1], 0)


def test_the_mean_of_a_nonlinear_drift_is_not_the_drift_of_the_mean(tmp_path: Path) -> None:
    # dm/dt = 1 - a (m^2 + P) and dP/dt = -4 a m P + s^2 are the moments of a normal x; with steps h the error is h^3.
    def slopes(t: float, z: Array) -> list[float]:
        return [1 - 0.4 * (z[0] ** 2 + z[1]), -1.6 * z[0] * z[1] + 0.25]

    mean, variance = solve_ivp(slopes, (0, 1), [1.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]
    errors = []
    for step in (0.2, 0.1):
        engine, vector = engine_of(tmp_path, QUADRATIC, "t,x,y\n0,1,1\n1,1,1\n", max_step=step)
        found = engine.filtered(vector, seen=np.zeros_like(engine.problem.valued))
        errors.append([found.end_mean[-1, 0] - mean, found.end_cov[-1, 0, 0] - variance])
        # E x^2 is m^2 + P, with the variance 4 m^2 P + 2 P^2 beside that of the noise
        m, p = found.end_mean[-1, 0], found.end_cov[-1, 0, 0]
        assert found.mean[-1, 1] == pytest.approx(m**2 + p, rel=1e-7)
        found = engine.filtered(vector, seen=np.array([[False, False], [False, True]]))
        assert found.variance[-1, 1] == pytest.approx(4 * m**2 * p + 2 * p**2 + 0.01, rel=1e-6)
    assert np.abs(errors[1]).max() < 1e-5
    assert (np.abs(errors[1]) < np.abs(errors[0]) / 8).all()


def test_where_a_function_has_no_value_points_move_to_the_mean(tmp_path: Path) -> None:
    text = QUADRATIC.replace("1 - a*x^2", "1 - a*x*sqrt(x)").replace("= 0.5 in [0, 2]", "= 2 in [0, 5]")
    engine, vector = engine_of(tmp_path, text, "t,x,y\n0,1,1\n0.5,1,1\n1,1,1\n", max_step=0.1)
    found = engine.filtered(vector)
    assert found.finite
    information, h = engine.information(vector, found), 1e-5
    for place in np.flatnonzero(engine.layout.free):
        step = h * np.eye(len(vector))[place]
        change = (engine.value(vector + step) - engine.value(vector - step)) / (2 * h)
        assert information.gradient[place] == pytest.approx(change, rel=1e-4, abs=1e-4)


class Counted(np.ndarray):
    """An array that counts the small products of which it is the left side."""

    products = 0

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Array, **options: object) -> Array:
        plain = [np.asarray(each) for each in inputs]
        found = np.asarray(getattr(ufunc, method)(*plain, **options))
        if ufunc is np.matmul:
            Counted.products += int(np.prod(found.shape[:-2]))
        return found


@pytest.mark.parametrize(("count", "p"), [(5, 40), (0, 40), (5, 0)])
def test_slopes_are_multiplied_by_a_matrix_all_at_once(count: int, p: int) -> None:
    """One product for each matrix, not for each of its derivatives; tables that do not lie in a row are multiplied as
    they are."""
    random = np.random.default_rng(2)
    slopes, right = random.standard_normal((count, p, 3, 2)), random.standard_normal((count, 2, 4))
    value = random.standard_normal((count, 3, 2))
    Counted.products = 0
    found = (Varied(value, slopes.view(Counted)) @ Varied(right)).slopes
    assert found is not None
    assert Counted.products == count
    assert found.shape == (count, p, 3, 4)
    np.testing.assert_allclose(found, np.einsum("bpij,bjk->bpik", slopes, right), atol=1e-14)
    turned = np.ascontiguousarray(slopes.swapaxes(1, 3)).swapaxes(1, 3)
    again = (Varied(value, turned) @ Varied(right)).slopes
    np.testing.assert_allclose(again, found, atol=1e-14)
