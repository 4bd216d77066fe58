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
