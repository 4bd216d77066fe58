"""Initial values of states whose size nothing declares: no measurement, no range, no guess.

The counts of a radioactive sample are known, the nuclei in it are not: their number may be 1 or 1e20, and it follows
from the counts by the constants. So for given constants such initial values are the least-squares solution of the
linearised problem, in whatever unit; among constants drawn from their ranges the best solution shows the size.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import sobol, spread_over_ranges
from gbspec.ir import Model
from gbspec.training.engines import Engine, linearise, residual_vector
from gbspec.training.optimise import huber
from gbspec.training.problem import STRETCH, Integers

DRAWS = 32
"""So many values of the constants are drawn, besides the given ones."""
STEPS = 3
"""Steps of Gauss and Newton: one is enough where channels are linear in the initial values."""
ENOUGH = 0.99
"""A step that leaves more than this of the loss is the last one."""
CUT = 1e-9
"""Singular values below this fraction of the largest count as zero: such directions stay as they are."""


def unsized(model: Model, covered: Mask, free: Array) -> Mask:
    """The states [n_states] that are learned at the start and of unknown size: `covered` are those of which a curve
    through measurements is known, `free` [N, n_states] is 1 where an initial value is learned."""
    declared = [s.start is not None or (s.range is not None and s.range.bounded) for s in model.states]
    return np.asarray((free > 0).any(axis=0) & ~covered & ~np.array(declared, dtype=np.bool_), dtype=np.bool_)


def solved_starts(engine: Engine, theta: Array, states: Mask, steps: int = 1) -> Array:
    """The vector with the learned initial values of some states [n_states] by linear least squares, each trajectory for
    itself and without damping, where this lessens the residuals."""
    parameters, loss = engine.parameters, _loss(engine, theta)
    for _ in range(steps):
        trial = theta.copy()
        trial[parameters.n_shared :] += _step(engine, theta, states).ravel()
        reached = _loss(engine, trial)
        if not reached < loss:
            break
        enough = reached > ENOUGH * loss
        theta, loss = trial, reached
        if enough:
            break
    return theta


def sized_starts(engine: Engine, theta: Array, states: Mask, seed: int) -> tuple[Array, Array] | None:
    """Initial values [N, n_states] with those of some states from the best of several draws of the constants, and the
    sizes [n_states] of these states; None if no solution was found."""
    parameters = engine.parameters
    learnables = parameters.model.learnables
    drawn = spread_over_ranges(learnables, sobol(DRAWS, len(learnables), seed)) if learnables else ()
    candidates = [theta, *(parameters.vector(parameters.natural(theta), values) for values in drawn)]
    solved = [solved_starts(engine, each, states, STEPS) for each in candidates]
    losses = [_loss(engine, each) for each in solved]
    if not np.isfinite(losses).any():
        return None
    best = solved[int(np.argmin(losses))]
    starts = parameters.natural(best)["initial"]
    # Where a value is about zero, what would change a channel by its deviation, but no more than the size without data.
    visible = np.minimum(parameters.start_scale, _visible(engine, best))
    return starts, np.maximum(np.median(np.abs(starts), axis=0), visible)


def _local(engine: Engine, theta: Array) -> tuple[Array, Array, Integers]:
    """Residuals, their derivatives by the trajectories' own initial values, and the trajectories of the rows."""
    system = linearise(engine, theta, only_local=True)
    own = len(engine.parameters.own)
    if not len(system.owner):
        return np.zeros(0), np.zeros((0, engine.parameters.n_local - own)), np.zeros(0, dtype=np.int64)
    return system.residuals.numpy(), system.local.numpy()[:, own:], system.owner.numpy()


def _step(engine: Engine, theta: Array, states: Mask) -> Array:
    """The step of Gauss and Newton in the trajectories' blocks [N, n_local], zero for all but the initial values."""
    parameters, own = engine.parameters, len(engine.parameters.own)
    step = np.zeros((parameters.trajectories, parameters.n_local))
    residuals, local, owner = _local(engine, theta)
    for k in range(len(step) if len(owner) else 0):
        columns = np.flatnonzero(states & (parameters.start_free[k] > 0))
        rows = local[owner == k][:, columns]
        norms = np.linalg.norm(rows, axis=0)
        seen = norms > 0
        if seen.any():
            move = np.linalg.lstsq(rows[:, seen] / norms[seen], residuals[owner == k], rcond=CUT)[0]
            step[k, own + columns[seen]] = -move / norms[seen]
    return step


def _visible(engine: Engine, theta: Array) -> Array:
    """The changes of initial values [n_states] of which residuals show one standard deviation; infinite: none."""
    _, local, _ = _local(engine, theta)
    unit = STRETCH * engine.parameters.start_scale
    with np.errstate(divide="ignore"):
        return np.asarray(unit * np.sqrt(max(len(local), 1)) / np.linalg.norm(local, axis=0))


def _loss(engine: Engine, theta: Array) -> float:
    residuals = residual_vector(engine, theta)
    return huber(residuals, 1.0) if np.isfinite(residuals).all() else float("inf")
