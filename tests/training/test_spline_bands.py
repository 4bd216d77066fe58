"""Bands of splines: they contain the truth where the spline can follow it; where it cannot, the fit says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gbspec.analysis import function_bands
from gbspec.backends import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir.methods import METHODS
from gbspec.ir.model import Model
from gbspec.operations import fitting
from gbspec.passes.splines import LEVEL
from gbspec.runs import Run
from gbspec.training import TrainOptions
from gbspec.training.engines import residual_vector
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.problem import Parameters
from gbspec.training.runs.coarseness import _finer, _places, _weights
from tests.training.conftest import problem_of, trajectory

TEXT = "model m\ntime t\nstate x in [0, 4]\nunknown f(x) by spline({size})\nx' = -f(x)\nobserve x\n"
TWO = """
model s
state a in [0, 3]
state b in [0, 2]
unknown f, h(a) >= 0, zero at a = 0, increasing in a by spline(7)
unknown g(a, b) by spline(5, 6)
a' = 1 - f
b' = 0.5 - b + 0.1*g + 0.2*h
observe a
observe b
"""


def model_of(text: str) -> Model:
    return load_model("m.gb", Findings(), lambda path: Source(str(path), text))


def truth(x: np.ndarray) -> np.ndarray:
    return np.asarray(0.6 + 0.4 * np.sin(3 * x))


def falling(noise: float, seed: int) -> Trajectories:
    rng, items = np.random.default_rng(seed), []
    for number, start in enumerate((4.0, 3.4, 2.8, 2.2, 1.6)):
        times = np.linspace(0.0, 2 * start, 25)
        solved = solve_ivp(lambda t, x: -truth(x), (0.0, times[-1]), [start], t_eval=times, rtol=1e-9)
        values = solved.y.T + noise * rng.standard_normal((len(times), 1))
        items.append(trajectory(str(number), 0.0, times, values, []))
    return Trajectories(tuple(items), ("x",))


def fitted(size: int, place: Path, seed: int = 1) -> Run:
    options = TrainOptions(threads=1, seed=1, effort="low")
    return fitting.fit(model_of(TEXT.format(size=size)), falling(0.05, seed), place / "run", options)


@pytest.mark.usefixtures("quick_fit")
def test_bands_of_a_fine_spline_contain_the_truth(tmp_path: Path) -> None:
    run = fitted(14, tmp_path)
    points = np.linspace(0.2, 3.8, 73)[:, None]
    _, low, high = function_bands(run, "f", points)
    true = truth(points[:, 0])
    assert np.mean((low <= true) & (true <= high)) > 0.8
    assert np.mean(high - low) < 0.25
    assert not any("too coarse" in warning for warning in run.fit.warnings)


@pytest.mark.usefixtures("quick_fit")
def test_a_fit_says_that_a_spline_is_too_coarse(tmp_path: Path) -> None:
    warnings = fitted(6, tmp_path).fit.warnings
    assert any("the spline of `f` is too coarse" in text and "`by spline(9)`" in text for text in warnings)


@pytest.mark.parametrize("seed", [2, 3, 8])
@pytest.mark.usefixtures("quick_fit")
def test_the_prior_of_a_fine_spline_is_not_taken_for_its_coarseness(tmp_path: Path, seed: int) -> None:
    # the bias that the ridge leaves in residuals gave each of these sets probabilities below 0.01
    assert not any("too coarse" in warning for warning in fitted(14, tmp_path, seed).fit.warnings)


@pytest.mark.parametrize("size", [8, 24])
def test_a_prior_of_coefficients_means_the_same_for_any_number_of_them(size: int) -> None:
    module = load_module(model_of(TEXT.format(size=size)))
    weights = dict(module.random(0).weights)
    squares = 0.0
    for place in range(2, size):
        weights["network.f.0.bias"] = np.eye(size)[place]
        function = module(weights).functions["f"]
        # the deviation at the middle from the line through the ends: that of an integrated Wiener process, s/48^0.5
        ends = float(function(0.0)), float(function(4.0))
        squares += (float(function(2.0)) - 0.5 * sum(ends)) ** 2
    np.testing.assert_allclose(np.sqrt(squares), LEVEL / 48**0.5, rtol=0.1)


@pytest.mark.parametrize("index", [0, 1])
def test_the_finer_model_begins_with_the_same_functions(index: int) -> None:
    model = model_of(TWO)
    rng = np.random.default_rng(2)
    items = [trajectory(str(i), 0.0, np.arange(1.0, 4.0), rng.uniform(0.3, 1.0, (3, 2)), []) for i in range(2)]
    problem, parameters, theta = problem_of(model, Trajectories(tuple(items), ("a", "b")), 0.2)
    before = residual_vector(TorchEngine(problem, parameters), theta)
    finer = _finer(model, index)
    weights, extra = _weights(parameters, theta, finer, index)
    layout = Parameters(
        finer,
        parameters.start_value,
        parameters.start_scale,
        parameters.start_free,
        {name: weights[name] for name in parameters.fixed},
    )
    wide = np.concatenate([layout.vector(weights)[: layout.n_weights], theta[parameters.n_weights :]])
    module = load_module(finer, METHODS["rk4"])(weights)
    engine = TorchEngine(replace(problem, model=finer, module=module), layout)
    np.testing.assert_allclose(residual_vector(engine, wide), before, rtol=1e-12, atol=1e-13)
    moved = wide.copy()
    moved[_places(layout, finer.networks[index])[extra]] = 0.1
    assert np.abs(residual_vector(engine, moved) - before).max() > 1e-4
    assert len(extra) == (2 * 2 * 4, 2 + 3)[index]  # two splines for each function with a zero
