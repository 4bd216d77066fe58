"""Known forms whose solutions diverge: segments give the constants."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import gbspec

pytestmark = pytest.mark.usefixtures("quick_fits")

LORENZ = """\
model lorenz
state x
state y
state z
learn sigma = 5 in [0.1, 50]
learn rho = 20 in [1, 100]
learn beta = 1 in [0.1, 10]
x' = sigma*(y - x)
y' = x*(rho - z) - y
z' = x*y - beta*z
observe x
observe y
observe z
"""
DECAY = """\
model decay
state x in [-3, 3]
learn k = 1 in [0.01, 100]
learn a = 0 in [-10, 10]
x' = a - k*x
observe x
"""
SEARCH = """\
model unemployment
input v in [0.5, 6] held
state u in [1, 15]
learn s in [0.001, 0.2] = 0.02
learn m in [0.01, 2] = 0.3
learn a in [0, 1] = 0.5
u' = s*(100 - u) - m*u^a*v^(1 - a)
initial u = 5
observe u
"""


def table(path: Path, columns: list[str], rows: np.ndarray) -> Path:
    lines = [",".join(columns), *(",".join(f"{value:.8g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_chaotic_solutions_give_the_constants(tmp_path: Path) -> None:
    def rates(t: float, s: np.ndarray) -> list[float]:
        return [10 * (s[1] - s[0]), s[0] * (28 - s[2]) - s[1], s[0] * s[1] - 8 / 3 * s[2]]

    times = np.arange(0, 10, 0.05)
    exact = solve_ivp(rates, (0, 10), [-8, 7, 27], t_eval=times, rtol=1e-10, atol=1e-10).y.T
    noisy = exact + 0.02 * exact.std(axis=0) * np.random.default_rng(5).normal(size=exact.shape)
    (tmp_path / "lorenz.gb").write_text(LORENZ)
    data = table(tmp_path / "data.csv", ["t", "x", "y", "z"], np.column_stack([times, noisy]))
    fit = gbspec.load(tmp_path / "lorenz.gb").train(data, tmp_path / "run", effort="low").run.fit
    found = {name: fit.constants[name].value for name in ("sigma", "rho", "beta")}
    assert found == pytest.approx({"sigma": 10, "rho": 28, "beta": 8 / 3}, rel=0.01)


def test_a_model_that_is_wrong_keeps_the_least_squares_of_whole_solutions(tmp_path: Path) -> None:
    times = np.linspace(0, 20, 101)
    values = np.sin(times) + 0.3 * np.sin(3.1 * times)
    (tmp_path / "decay.gb").write_text(DECAY)
    data = table(tmp_path / "data.csv", ["t", "x"], np.column_stack([times, values]))
    fit = gbspec.load(tmp_path / "decay.gb").train(data, tmp_path / "run", effort="low").run.fit
    best = least_squares(residuals_of(times, values), [0.1, 1.0, 0.0])
    reached = residuals_of(times, values)(np.array([fit.constants["k"].value, fit.constants["a"].value, values[0]]))
    assert np.sum(reached**2) < 1.3 * np.sum(best.fun**2)  # the start is a measured value


def residuals_of(times: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    def residuals(p: np.ndarray) -> np.ndarray:
        k, a, x0 = p
        return a / k + (x0 - a / k) * np.exp(-k * times) - values

    return residuals


def test_a_calm_beginning_does_not_decide_against_the_whole_where_the_start_is_given(tmp_path: Path) -> None:
    rng, rows = np.random.default_rng(0), 135
    vacancies = np.round(3 + 1.2 * np.sin(np.arange(rows) / 18) + 0.3 * rng.standard_normal(rows), 2)

    def solved(s: float, m: float, a: float) -> np.ndarray:
        out, u = [5.0], 5.0
        for v in vacancies[:-1]:
            for _ in range(20):
                u += (s * (100 - u) - m * max(u, 1e-3) ** a * v ** (1 - a)) / 20
            out.append(u)
        return np.array(out)

    exact = solved(0.03, 0.8, 0.4)
    disturbance = 5 + 0.05 * np.arange(rows) - exact
    for i in range(13, rows):
        disturbance[i] = 0.97 * disturbance[i - 1] + 0.6 * rng.standard_normal()
    values = np.maximum(exact + disturbance, 1.0)
    (tmp_path / "search.gb").write_text(SEARCH)
    data = table(tmp_path / "data.csv", ["t", "v", "u"], np.column_stack([np.arange(rows), vacancies, values]))
    fit = gbspec.load(tmp_path / "search.gb").train(data, tmp_path / "run", effort="low").run.fit
    assert "growing horizons" in [stage.name for stage in fit.members[0].stages]
    bounds = ([0.001, 0.01, 0.0], [0.2, 2.0, 1.0])
    best = least_squares(lambda p: solved(*p) - values, [0.03, 0.8, 0.4], bounds=bounds)
    reached = solved(*(fit.constants[name].value for name in "sma")) - values
    assert np.sum(reached**2) < 1.02 * np.sum(best.fun**2)
