"""Likelihoods of models whose right-hand sides jump where a state passes a threshold, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize, minimize_scalar

from gbspec.arrays import Array
from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.data import Trajectories, Trajectory
from gbspec.operations.evaluating import of_model
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = """model decay
time t from 0
condition x0 in [1, 8]
state x in [0, 10]
learn k = 0.2 in [0.01, 5] per trajectory ~ lognormal(w)
learn w = 0.2 in [0.01, 2]
learn q = 1.5 in [0.1, 20]
learn s = 0.1 in [0.001, 2]
x' = -k*if(x > 1.5, 1, q)*x
initial x = x0
observe y = x noise normal(s)
"""
ALIKE = DECAY.replace(" per trajectory ~ lognormal(w)", "").replace("learn w = 0.2 in [0.01, 2]\n", "")
STARTS, TIMES = np.array([2.5, 3.1, 3.9, 4.6, 5.2, 5.9]), np.arange(0.5, 8.1, 0.5)
FAST = TrainOptions(workers=1, effort="low", quadrature=1)


def solution(k: Array, x0: float, q: float) -> tuple[Array, Array]:
    """Solutions [..., times] and their derivatives by log k: slow down to the threshold, then faster."""
    k = np.asarray(k)[..., None]
    switch = np.log(x0 / 1.5) / k
    before = x0 * np.exp(-k * TIMES)
    after = 1.5 * np.exp(-q * k * (TIMES - switch))
    return np.where(switch > TIMES, before, after), np.where(
        switch > TIMES, -k * TIMES * before, -q * k * TIMES * after
    )


def measured(spread: float) -> Trajectories:
    """Decays with a noise of 0.05."""
    random, found = np.random.default_rng(10), []
    for i, x0 in enumerate(STARTS):
        rate = 0.3 * np.exp(spread * random.normal())
        x = (solution(rate, x0, 4.0)[0] + 0.05 * random.normal(size=len(TIMES)))[:, None]
        found.append(Trajectory(str(i), 0.0, TIMES, x, np.ones_like(x), np.full_like(x, np.nan), np.array([x0])))
    return Trajectories(tuple(found), ("y",))


def laplace(data: Trajectories, k: float, w: float, q: float, s: float) -> float:
    """-2 log likelihood by Laplace's method with the expected Hessian."""
    total = 0.0
    for item, x0 in zip(data.items, STARTS, strict=True):
        y = item.values[:, 0]

        def joint(z: Array, x0: float = float(x0), y: Array = y) -> Array:
            residual = solution(k * np.exp(w * z), x0, q)[0] - y
            return (np.log(2 * np.pi * s**2) + residual**2 / s**2).sum(-1) + np.square(z)

        grid = np.linspace(-5, 5, 401)
        start = grid[int(np.argmin(joint(grid)))]
        mode = minimize_scalar(joint, bounds=(start - 0.03, start + 0.03), options={"xatol": 1e-10}, method="bounded")
        slope = w * solution(np.asarray(k * np.exp(w * mode.x)), x0, q)[1]
        total += float(joint(mode.x)) + np.log1p((slope**2).sum() / s**2)
    return total


def test_a_population_has_the_likelihood_and_gradient_of_the_closed_form() -> None:
    data, model, at = measured(0.3), model_of(DECAY), {"k": 0.31, "w": 0.28, "q": 3.8, "s": 0.055}
    found = of_model(model, data, at)
    assert 2 * found.nllh == pytest.approx(laplace(data, **at), abs=1e-5)
    for name, value in at.items():
        step = 1e-4 * value
        near = [laplace(data, **{**at, name: value + side * step}) / 2 for side in (1, -1)]
        assert found.gradient[name] == pytest.approx((near[0] - near[1]) / (2 * step), rel=1e-4, abs=2e-3)


def test_a_population_is_fitted_to_the_maximum(tmp_path: Path) -> None:
    data = measured(0.3)
    run = train(model_of(DECAY), data, FAST, tmp_path / "run")
    assert run.fit.population is not None
    best = lowest(lambda u: laplace(data, *np.exp(u)), [0.3, 0.3, 4.0, 0.05])
    assert run.fit.population.minus2ll == pytest.approx(best, abs=0.01)
    assert not any("jump" in text for text in run.fit.warnings)


def test_a_learned_noise_is_fitted_to_the_maximum(tmp_path: Path) -> None:
    data = measured(0.0)
    run = train(model_of(ALIKE), data, FAST, tmp_path / "run")

    def minus2ll(u: Array) -> float:
        k, q, s = np.exp(u)
        each = [solution(k, x0, q)[0] - item.values[:, 0] for item, x0 in zip(data.items, STARTS, strict=True)]
        return float((np.log(2 * np.pi * s**2) + np.square(each) / s**2).sum())

    assert run.fit.population is not None
    assert run.fit.population.minus2ll == pytest.approx(lowest(minus2ll, [0.3, 4.0, 0.05]), abs=1e-3)
    value, sd = run.fit.constants["k"].value, run.fit.constants["k"].sd
    rate = sum((solution(value, x0, run.fit.constants["q"].value)[1] ** 2).sum() for x0 in STARTS) / value**2
    assert sd is not None and sd >= 0.99 * run.fit.constants["s"].value / np.sqrt(rate)
    assert sd <= 1.5 * run.fit.constants["s"].value / np.sqrt(rate), "not that of slopes without the jump"


def test_without_cut_steps_it_is_said_that_derivatives_are_wrong(tmp_path: Path) -> None:
    options = TrainOptions(workers=1, effort="low", quadrature=1, switches="off")
    run = train(model_of(ALIKE), measured(0.0), options, tmp_path / "run")
    (said,) = [text for text in run.fit.warnings if "jump" in text]
    assert "`--switches off`" in said and "may rest beside the best values" in said


def lowest(function: Callable[[Array], float], start: list[float]) -> float:
    """The minimum over logarithms, near a start."""
    found = minimize(function, np.log(start), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-6})
    return float(found.fun)
