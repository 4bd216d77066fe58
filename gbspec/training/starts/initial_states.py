"""Refits the initial states (and own constants) trajectory by trajectory, with all shared parameters fixed.

Candidates around the current initial state are tried for all trajectories in one batch; the best one of each is
improved by Levenberg-Marquardt steps on the trajectories' own blocks, each with its own damping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.ir import Model, Range
from gbspec.training.engines import Engine, linearise, residual_table, residual_vector, taken
from gbspec.training.optimise import LEAST_NOISE, Priors, huber_each, huber_weights, root_mean_square
from gbspec.training.problem import Forcing, Integers, Packed, Parameters, Problem, typical

POLISH_STEPS = 12
FLAT = 1e-12
"""The smallest damping of a step, relative to the trace of its Hessian."""
HUBER = 0.3
"""Residuals beyond this many standard deviations count linearly, so that no single outlier determines the result."""


def refit_starts(engine: Engine, theta: Array, seed: int, candidates: int = 32, radius: float = 1.0) -> Array:
    """The vector with improved initial states: no trajectory's own loss over its first rows increases.

    `radius` is the size of the box of candidates in units of the states' standard deviations. Starts of states that no
    channel shows alone stay in their declared ranges, where they are in them: the data may say next to nothing of such
    states while functions are wrong.
    """
    parameters = engine.parameters
    if not parameters.start_free.any():
        return theta
    problem = first_rows(engine.problem, _influence(engine.problem))
    window = engine.rebound(problem, parameters)
    # The same noise throughout, so that losses with priors are comparable.
    residuals, stated = problem.of_noise(residual_vector(window, theta)), problem.scaling.noise
    noise = max(typical(residuals) if stated is None else stated, root_mean_square(residuals), LEAST_NOISE)
    problem = replace(problem, scaling=replace(problem.scaling, noise=noise if np.isfinite(noise) else 0.0))
    window = engine.rebound(problem, parameters)
    best, losses = theta, trajectory_losses(window, theta)
    starts = _starts(parameters, theta)
    width = parameters.start_free * parameters.start_scale * radius
    low, high = _ranges(engine.problem.model, starts)
    points = np.random.default_rng([seed, 23]).uniform(-1, 1, (candidates, len(parameters.start_scale)))
    for fraction in (1.0, 0.25):
        tried = np.clip(starts[:, None] + width[:, None] * points * fraction, low[:, None], high[:, None])
        found = _best_candidates(window, best, tried)
        best, losses = _keep_better(window, best, found, losses)
        starts = _starts(parameters, best)

    def within(vector: Array) -> Array:
        reached = _starts(parameters, vector)
        inside = np.clip(reached, low, high)
        return vector if np.array_equal(inside, reached) else parameters.with_starts(vector, inside)

    return polish(window, best, losses, within=within)


def _ranges(model: Model, starts: Array) -> tuple[Array, Array]:
    """The least and largest initial states [N, n_states] that are tried: present ones are always among them."""
    states = {state.symbol for state in model.states}
    shown = [value.free_symbols & states for value in model.inlined([channel.value for channel in model.channels])]
    ranges = [Range() if {state.symbol} in shown else state.range or Range() for state in model.states]
    low, high = (np.array(ends) for ends in zip(*((each.low, each.high) for each in ranges), strict=True))
    return np.minimum(low, starts), np.maximum(high, starts)


def first_rows(problem: Problem, count: int) -> Problem:
    """The problem with no more than the first `count` key rows of each trajectory."""
    packed = problem.packed
    keep = packed.row_index < count
    steps = np.zeros(packed.trajectories, dtype=np.int64)
    np.maximum.at(steps, packed.row_trajectory[keep], packed.row_step[keep])
    depth = int(steps.max(initial=0))
    h = packed.h[:depth].copy()
    h[np.arange(depth)[:, None] >= steps[None, :]] = 0.0
    cut = {
        name: getattr(packed, name)[keep]
        for name in (
            "row_trajectory",
            "row_index",
            "row_step",
            "row_time",
            "values",
            "weights",
            "sd",
            "row_inputs",
        )
    }
    limits = packed.limits.rows(keep)
    shorter: Packed = replace(
        packed, t=packed.t[:depth], h=h, inputs=packed.inputs[:depth], steps=steps, limits=limits, **cut
    )
    forcing = Forcing(problem.forcing.value[keep], problem.forcing.weight[keep])
    scaling = replace(problem.scaling, row_scale=problem.scaling.row_scale[keep])
    return replace(problem, packed=shorter, forcing=forcing, scaling=scaling)


def _influence(problem: Problem) -> int:
    """The number of rows after which the initial state no longer matters: until every state has been reset once, and a
    few more if there are unmeasured states."""
    packed, weight = problem.packed, problem.forcing.weight
    resettable = weight.max(axis=0, initial=0.0) >= 1.0
    if not resettable.all():
        return int(packed.row_index.max(initial=0)) + 1
    seen = np.zeros((packed.trajectories, weight.shape[1]), dtype=np.int64) + int(packed.row_index.max(initial=0))
    for state in range(weight.shape[1]):
        rows = np.flatnonzero(weight[:, state] >= 1.0)[::-1]
        seen[packed.row_trajectory[rows], state] = packed.row_index[rows]
    return int(seen.max(initial=0)) + 2


def _starts(parameters: Parameters, theta: Array) -> Array:
    with torch.no_grad():
        return np.asarray(parameters.starts(torch.from_numpy(theta)).numpy(), dtype=np.float64)


def trajectory_losses(engine: Engine, theta: Array) -> Array:
    """Huber loss of each trajectory [N]; infinite if its solution is not finite."""
    problem = engine.problem
    rho = huber_each(residual_table(engine, theta), HUBER).sum(axis=1)
    rho = np.where(np.isfinite(rho), rho, np.inf)
    losses = np.zeros(problem.packed.trajectories)
    np.add.at(losses, problem.packed.row_trajectory, rho)
    priors = Priors.of(problem, engine.parameters, np.zeros(0))
    if len(priors):
        np.add.at(losses, priors.owner, 0.5 * priors.rows(theta) ** 2)
    return losses


def _best_candidates(engine: Engine, theta: Array, candidates: Array) -> Array:
    """Each trajectory's best initial state [N, n_states] among `candidates` [N, count, n_states]."""
    parameters = engine.parameters
    n, count = candidates.shape[:2]
    index: Integers = np.repeat(np.arange(n, dtype=np.int64), count)
    many, tried = taken(engine, index), candidates.reshape(n * count, -1)
    vector = many.parameters.with_starts(parameters.take_vector(theta, index), tried)
    losses = trajectory_losses(many, vector).reshape(n, count)
    return np.asarray(tried.reshape(n, count, -1)[np.arange(n), losses.argmin(axis=1)], dtype=np.float64)


def _keep_better(engine: Engine, theta: Array, starts: Array, losses: Array) -> tuple[Array, Array]:
    return keep_blocks(engine, theta, engine.parameters.with_starts(theta, starts), losses)


def keep_blocks(engine: Engine, old: Array, new: Array, losses: Array) -> tuple[Array, Array]:
    """The vector with each trajectory's block from `new` if its loss is smaller, and the losses."""
    trial, parameters = trajectory_losses(engine, new), engine.parameters
    better = trial < losses
    out = old.copy()
    blocks = out[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
    blocks[better] = new[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)[better]
    return out, np.where(better, trial, losses)


def polish(
    engine: Engine,
    theta: Array,
    losses: Array,
    steps: int = POLISH_STEPS,
    within: Callable[[Array], Array] = lambda vector: vector,
) -> Array:
    """The vector with the trajectories' blocks improved by damped steps, each block with its own damping; `within`
    moves a vector back to what is allowed."""
    parameters = engine.parameters
    n, width = parameters.trajectories, parameters.n_local
    damping = np.full(n, 1e-2)
    for _ in range(steps):
        system = linearise(engine, theta, only_local=True)
        if len(system.owner) == 0 or not np.isfinite(system.residuals.numpy()).all():
            break
        system = Priors.of(engine.problem, parameters, np.zeros(0)).with_rows(system, theta)
        residuals = system.residuals.numpy()
        weight = huber_weights(residuals, HUBER)
        local, owner = system.local.numpy(), system.owner.numpy()
        hessian, gradient = np.zeros((n, width, width)), np.zeros((n, width))
        np.add.at(hessian, owner, local[:, :, None] * (weight[:, None] * local)[:, None, :])
        np.add.at(gradient, owner, local * (weight * residuals)[:, None])
        step = damped_steps(hessian, gradient, damping)
        trial = theta.copy()
        trial[parameters.n_shared :] += step.ravel()
        theta, new = keep_blocks(engine, theta, within(trial), losses)
        improved = new < losses
        damping = np.where(improved, damping / 5, damping * 4)
        if not (new < losses * (1 - 1e-6) - 1e-15).any() and (damping > 1e3).all():
            break
        losses = new
    return theta


def damped_steps(hessian: Array, gradient: Array, damping: Array) -> Array:
    """Steps [N, k] from Hessians [N, k, k] (positive semidefinite), gradients [N, k] and dampings [N].

    Each damping is at least FLAT times its Hessian's trace: it decreases with every success, and the equations
    must not become singular in directions that the data do not determine.
    """
    least = FLAT * np.trace(hessian, axis1=1, axis2=2)
    diagonal = np.maximum(np.maximum(damping, least), np.finfo(float).tiny)
    width = hessian.shape[1]
    system = hessian + diagonal[:, None, None] * np.eye(width)
    return np.asarray(-np.linalg.solve(system, gradient[:, :, None])[:, :, 0], dtype=np.float64)
