"""Constants that each trajectory has for itself, found globally with all shared parameters fixed.

Given the shared parameters, the trajectories do not depend on one another, and each has few constants: draws over the
constants' whole ranges are improved by a few steps for all trajectories in one batch (before that, the best ones are
often merely those with the smallest effect), and the best few of each one by more.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.data import sobol, spread_over_ranges
from gbspec.training.engines import Engine, taken
from gbspec.training.problem import Integers
from gbspec.training.starts.initial_states import POLISH_STEPS, keep_blocks, polish, trajectory_losses

DRAWS, KEPT = 64, 4
"""Draws of a trajectory's constants, and how many of them are improved until they rest."""
SCREENED = 4
"""Steps of all draws before they are compared."""
WORK = 3e6
"""Above this number of sub-steps of all draws, they are compared as they are."""


def refit_own(engine: Engine, theta: Array, seed: int, draws: int = DRAWS, kept: int = KEPT) -> Array:
    """The vector with the best constants per trajectory (and initial states) that are found: no trajectory's loss
    increases."""
    parameters = engine.parameters
    if not parameters.own or not parameters.trajectories:
        return theta
    n, width = parameters.trajectories, parameters.n_local
    blocks = np.repeat(theta[parameters.n_shared :].reshape(n, 1, width), 1 + draws, axis=1)
    learnables = tuple(parameters.model.learnables[i] for i in parameters.own)
    points = spread_over_ranges(learnables, sobol(draws, len(learnables), seed))
    blocks[:, 1:, : len(learnables)] = parameters.bijections(parameters.own).from_natural(points)
    # One solution that blows up would stop the steps of all others.
    losses = _losses(engine, theta, blocks)
    blocks = np.where(np.isfinite(losses)[:, :, None], blocks, blocks[np.arange(n), losses.argmin(axis=1)][:, None])
    if int(engine.problem.packed.steps.sum()) * (1 + draws) <= WORK:
        blocks = _polished(engine, theta, blocks, SCREENED)
    losses = _losses(engine, theta, blocks)
    best = np.argsort(losses, axis=1)[:, : kept + 1]
    best[:, -1] = np.where((best == 0).any(axis=1), best[:, -1], 0)  # the present constants are always among them
    blocks = np.take_along_axis(blocks, best[:, :, None], axis=1)
    polished = _polished(engine, theta, blocks, POLISH_STEPS)
    chosen = _losses(engine, theta, polished).argmin(axis=1)
    new = np.concatenate([theta[: parameters.n_shared], polished[np.arange(n), chosen].ravel()])
    return keep_blocks(engine, theta, new, trajectory_losses(engine, theta))[0]


def _batch(engine: Engine, theta: Array, blocks: Array) -> tuple[Engine, Array]:
    """The engine of every trajectory repeated for each of its `blocks` [N, count, n_local], and their vector."""
    index: Integers = np.repeat(np.arange(len(blocks), dtype=np.int64), blocks.shape[1])
    return taken(engine, index), np.concatenate([theta[: engine.parameters.n_shared], blocks.ravel()])


def _losses(engine: Engine, theta: Array, blocks: Array) -> Array:
    many, vector = _batch(engine, theta, blocks)
    return trajectory_losses(many, vector).reshape(blocks.shape[:2])


def _polished(engine: Engine, theta: Array, blocks: Array, steps: int) -> Array:
    many, vector = _batch(engine, theta, blocks)
    found = polish(many, vector, trajectory_losses(many, vector), steps)
    return found[engine.parameters.n_shared :].reshape(blocks.shape)
