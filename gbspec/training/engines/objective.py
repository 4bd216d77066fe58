"""The functions that optimisers evaluate with any engine: residuals, their Jacobian, the loss and its gradient."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.engines.engine import Engine, Moments
from gbspec.training.engines.linearised import Linearised
from gbspec.training.problem import Integers, Parameters, Problem, measured_only, residual_slopes, residuals_of


def predicted(engine: Engine, theta: Array) -> Moments:
    """The model's predictions at a vector."""
    return engine.moments(theta, engine.plan(theta))


def residual_table(engine: Engine, theta: Array) -> Array:
    """Residuals [R, C] at a vector, 0 where nothing was measured; NaN or infinite where the solution is not finite."""
    return residuals_of(engine.problem, predicted(engine, theta).mean)


def residual_vector(engine: Engine, theta: Array) -> Array:
    """Residuals of the m measured values, row by row; NaN or infinite where the solution is not finite."""
    return measured_only(engine.problem, residual_table(engine, theta))


def linearise(engine: Engine, theta: Array, only_local: bool = False) -> Linearised:
    """Residuals and their exact Jacobian at `theta`; with `only_local` the shared columns stay empty.

    If the solution is not finite, the residuals contain NaN or infinities and there is no Jacobian; the caller must
    check for this.
    """
    problem, path = engine.problem, engine.plan(theta)
    moments = engine.moments(theta, path)
    residuals = torch.from_numpy(measured_only(problem, residuals_of(problem, moments.mean)))
    if not (bool(torch.isfinite(residuals).all()) and np.isfinite(moments.before).all()):
        empty = torch.zeros((0, 0), dtype=torch.float64)
        return Linearised(empty, empty, torch.zeros(0, dtype=torch.int64), residuals)
    scale = residual_slopes(problem, moments.mean)
    found = engine.jacobian(theta, path, moments, scale, only_local)
    return Linearised(found.shared, found.local, found.owner, residuals)


def half_squares(engine: Engine, theta: Array, index: Integers | None = None) -> tuple[float, Array]:
    """Sum of half squared residuals of the trajectories `index` (None: all), and its gradient in the whole vector."""
    return engine.half_squares(theta, engine.plan(theta), index)


def loss_and_gradient(engine: Engine, theta: Array) -> tuple[float, Array]:
    """Mean of half squared residuals, and its gradient."""
    count = max(int(engine.problem.seen.sum()), 1)
    value, gradient = half_squares(engine, theta)
    return value / count, gradient / count


def objective(
    problem: Problem,
    parameters: Parameters,
    backend: Literal["native", "torch"] = "native",
    precision: Literal["float64", "float32"] = "float64",
    batch: int | None = None,
) -> Callable[[Array], tuple[float, Array]]:
    """The training loss of a packed problem and its gradient as a function of the trainable vector [size].

    The loss is the mean of half squared residuals over all measured values; vector and gradient are float64 arrays.
    `backend="native"` compiles the kernel on the first call for a model (seconds, kept in the user's cache) and runs it
    on `torch.get_num_threads()` threads. `backend="torch"` unrolls the torch graph, at most `batch` trajectories at a
    time. Both work in the requested precision. Raises ValueError if the native kernel is not available.

        f = objective(problem, parameters, "native")
        loss, gradient = f(theta)
    """
    if backend == "native":
        found: Engine = native_engine(problem, parameters, precision)
    else:
        found = torch_engine(problem, parameters, precision=precision, batch=batch)
    return lambda theta: loss_and_gradient(found, theta)
