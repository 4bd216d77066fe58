"""What is said of a fitted member: errors by channel, noise, initial states, and the constants' standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from gbspec.data.trajectories import Array
from gbspec.training.context import Context
from gbspec.training.parameters import Parameters
from gbspec.training.stages import STARTS_TOO
from gbspec.training.unroll import observe_rows, unroll


@dataclass
class MemberResult:
    """A member's part of `fit.json`; arrays in natural units.

    `rmse` and `noise` by channel: root mean square of prediction minus value of the autoregressive solution (NaN where
    it blew up) and the estimated standard deviation of the noise; `constants` by name; `sd` by name (NaN: not known);
    `correlations` [k, k] of the constants that all trajectories share, empty where not known;
    `failed` names the trajectories whose autoregressive solution blew up.
    """

    seed: int
    loss: float
    rmse: dict[str, float]
    noise: dict[str, float]
    constants: dict[str, float]
    sd: dict[str, float]
    seconds: float
    stages: list[dict[str, Any]]
    initial: Array
    labels: list[str]
    failed: list[str] = field(default_factory=list)
    history: list[tuple[str, int, float, float, tuple[float, ...]]] = field(default_factory=list)
    finished: bool = True
    notes: list[str] = field(default_factory=list)
    correlations: Array = field(default_factory=lambda: np.zeros((0, 0)))


def summarise(
    context: Context,
    parameters: Parameters,
    theta: Array,
    loss: float,
    seconds: float,
    stages: list[dict[str, Any]],
) -> MemberResult:
    """Evaluates a member at `theta`."""
    model = context.model
    problem = context.problem(0.0)
    vector = torch.from_numpy(theta)
    with torch.no_grad():
        solution = unroll(problem, parameters, vector)
        constants = parameters.constants(vector)
        networks = context.module.torch_networks(parameters.weights(vector))
        owner = torch.from_numpy(problem.packed.row_trajectory)
        predicted = observe_rows(problem, solution.arrival, constants[owner], networks).numpy()
    difference = predicted - problem.packed.values
    seen = problem.packed.weights > 0
    blown = seen & ~np.isfinite(predicted)
    failed = sorted({problem.packed.labels[i] for i in problem.packed.row_trajectory[blown.any(axis=1)]})
    rmse, noise = {}, {}
    forced = _forced_residuals(context, parameters, theta, [str(stage["name"]) for stage in stages])
    for i, channel in enumerate(model.channels):
        column = difference[seen[:, i], i]
        rmse[channel.name] = float(np.sqrt(np.mean(column**2))) if len(column) else float("nan")
        noise[channel.name] = _robust_deviation(forced[seen[:, i], i]) * float(problem.scaling.channel[i])
    known = len(model.constants)
    values = constants.numpy()[:, known:].mean(axis=0)
    names = [k.name for k in model.learnables]
    return MemberResult(
        context.seed,
        loss,
        rmse,
        noise,
        dict(zip(names, map(float, values), strict=True)),
        {name: float("nan") for name in names},
        seconds,
        [dict(stage) for stage in stages],
        solution.initial.numpy().copy(),
        list(context.packed().labels),
        failed,
    )


def _forced_residuals(context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]) -> Array:
    """Residuals [R, C] with the forcing that was trained with, in units of the channels' scales.

    Where constants alone were fitted, to whole solutions, they are scaled up for the degrees of freedom that it took.
    """
    alone = not parameters.n_weights and (context.options.forcing, context.options.method) == ("teacher", "auto")
    with torch.no_grad():
        out = unroll(context.problem(0.0 if alone else context.options.blend), parameters, torch.from_numpy(theta))
    residuals = np.asarray(out.residuals.numpy(), dtype=np.float64)
    if not alone:
        return residuals
    count = int((context.packed().weights > 0).sum())
    # Measured first values are fitted only by a stage of their own.
    free = (parameters if STARTS_TOO in stages else context.parameters(parameters.fixed)).free
    left = max(count - float(free.sum()), 0.1 * count, 1.0)
    return residuals * float(np.sqrt(count / left))


def _robust_deviation(residuals: Array) -> float:
    """1.4826 times the median absolute residual: the standard deviation, untroubled by a few bad values."""
    finite = residuals[np.isfinite(residuals)]
    return 1.4826 * float(np.median(np.abs(finite))) if len(finite) else float("nan")
