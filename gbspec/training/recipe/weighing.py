"""The weights of channels whose noise is not stated: it is estimated from the residuals, and the fit is continued.

This is iteratively reweighted least squares, which maximises the likelihood with the channels' standard deviations
concentrated out (Seber and Wild, Nonlinear Regression, 1989, 2.2.5 and 11.2). Each channel's variance is the sum of its
squared residuals over the number of its values less the degrees of freedom that the fit has taken from it; both have
what replicates differ by from their averages. Residuals that follow one another count less: of n values with a
correlation c of successive residuals, n (1 - c) / (1 + c) count (somewhat more in short trajectories).

A dense channel that the model cannot follow exactly would bend a fit away from all others, whose noise would then be
overestimated. So where numbers of values differ much, channels have other weights until then (see `first`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import Estimated, deviations, unstated
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Engine, linearise, residual_table
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, NormalEquations, Stage, evidence
from gbspec.training.problem import (
    Integers,
    Parameters,
    autocorrelation_of,
    in_time,
    limited,
    share_that_counts,
    typical,
)
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.planned import Decision, Planned, Reached, step_fraction
from gbspec.training.stages import StageName

REWEIGHTINGS = 3
"""How often the weights of channels may be estimated again."""
CLEAN = 1e-3
"""The least standard deviation of noise that is estimated, relative to that of the data: channels that are fitted this
closely count as exact, and weigh equally."""
UNEQUAL = 5.0
"""Above this ratio of the channels' numbers of values they are weighed from the beginning."""
NOTICED, SETTLED = 0.25, 0.1
"""Weights are introduced where the ratio of two scales changes by more than `NOTICED` (of its logarithm), and changed
while it changes by more than `SETTLED`."""
CHANCE = 2.0
"""Weights are introduced where that ratio changes by more than so many standard deviations of its estimate."""
LEAST_LEFT = 0.25
"""The least share of a channel's values that is taken to be left by a fit."""
TOLD = 25
"""At least so many values count, if there are so many: the correlation of the residuals of fewer is known to 0.2 at
best, and a channel that counts too little is followed even less, so that they become more correlated."""
WEAK = 1e-2
"""Precision of a prior on all entries in the count of degrees of freedom, relative to the noise."""
PROBES, ROUNDS = 24, 6
"""Random vectors for the trace of a channel's part of the projection, and steps to the ridge of greatest evidence."""


def reweighed(
    context: Context,
    most: int,
    layout: Callable[[Reached], Parameters],
    options: Callable[[Reached], LevenbergOptions],
    wanted: Decision,
) -> Planned:
    """The stage that continues whole solutions, by at most `most` iterations, with channels weighed by their noise."""

    def engine_of(reached: Reached) -> Engine:
        return context.engine(layout(reached), 0.0, step_fraction(reached.begun))

    known: dict[bytes, Estimated | None] = {}  # the decision and the weights need the same estimate

    def found(reached: Reached) -> Estimated | None:
        key = reached.theta.tobytes()
        if key not in known:
            known.clear()
            known[key] = estimated(context, engine_of(reached), reached.theta, options(reached).ridge)
        return known[key]

    def make(reached: Reached) -> Stage:
        engine = engine_of(reached)
        return LevenbergMarquardt(StageName.WEIGHTS.value, most, lambda iteration: engine, options(reached))

    def differ(reached: Reached) -> bool:
        noise = found(reached) if wanted(reached) else None
        return noise is not None and unsettled(context, noise)

    return Planned(StageName.WEIGHTS, most, make, possible=differ, weigh=found)


def noise_table(engine: Engine, theta: Array) -> Array:
    """Residuals [R, C] with the standard deviation of the noise, however much the channels count."""
    table, share = residual_table(engine, theta), engine.problem.scaling.share
    return table if share is None else np.asarray(table / np.sqrt(share), dtype=np.float64)


def weighable(context: Context) -> Mask:
    """The channels [C] whose noise is estimated: those that do not state it, if there is another one to weigh them
    against."""
    free = unstated(context.model, context.trajectories)
    measured = context.problem().seen.any(axis=0)
    return free if measured.sum() > 1 else np.zeros_like(free)


def first(context: Context) -> Estimated | None:
    """The weights until residuals are known; None if the numbers of the channels' values differ little, or if the
    channel with most of them is exact.

    Channels count equally if all functions are known. Networks need the information of every value from the first stage
    on: the noise is then that of the differences of successive values, which where these are far apart is too large,
    but is not taken to be more than that of the channel with most values.
    """
    count, free = context.problem().seen.sum(axis=0), weighable(context)
    if free.sum() < 2 or count[free].max() <= UNEQUAL * count[free].min():
        return None
    deviation = deviations(context.model, context.trajectories)
    rough = np.array([_of_differences(context, i) for i in range(len(count))]) / deviation
    dense = float(rough[np.argmax(np.where(free, count, 0))])
    if not dense > CLEAN:
        return None
    if context.model.networks:
        noise = np.where(free, np.clip(np.where(np.isfinite(rough), rough, dense), CLEAN, dense) * deviation, np.nan)
        return Estimated(noise, np.ones(len(count)))
    share = np.where(free, count[free].min() / np.maximum(count, 1), 1.0)
    return Estimated(np.full(len(count), np.nan), share)


def _of_differences(context: Context, channel: int) -> float:
    """The standard deviation of noise from the distances of values to the lines between their neighbours (Gasser, Sroka
    and Jennen-Steinmetz 1986), from their median; NaN if there are none."""
    found = [np.zeros(0)]
    for item in context.trajectories.items:
        seen = np.isfinite(item.values[:, channel])
        t, y = item.times[seen], item.values[seen, channel]
        if len(t) > 2:
            left = (t[2:] - t[1:-1]) / (t[2:] - t[:-2])
            found.append((left * y[:-2] + (1 - left) * y[2:] - y[1:-1]) / np.sqrt(left**2 + (1 - left) ** 2 + 1))
    distances = np.concatenate(found)
    return typical(distances) if len(distances) else float("nan")


def estimated(context: Context, engine: Engine, theta: Array, ridge: float) -> Estimated | None:
    """The noise of the channels at a vector; None if it is negligible in all of them, or not known."""
    free, problem = weighable(context), engine.problem
    table, seen, scale = residual_table(engine, theta), problem.seen, problem.scaling.channel
    if not free.any() or not np.isfinite(table[seen]).all():
        return None
    deviation = deviations(context.model, context.trajectories)
    used, (scatter, more) = _used(engine, theta, ridge), problem.replicates
    counted = np.ones(len(free)) if problem.scaling.share is None else problem.scaling.share
    noise, share = np.full(len(free), np.nan), np.ones(len(free))
    for i in np.flatnonzero(free):
        rows = in_time(problem, int(i))
        column = table[rows, i]
        left = max(len(column) - used[i], LEAST_LEFT * len(column), 1.0)
        squares = np.sum(limited(column) ** 2) + counted[i] * scatter[i]
        noise[i] = scale[i] * float(np.sqrt(squares / (left + more[i])))
        share[i] = share_of(column, problem.packed.row_trajectory[rows])
    if (noise[free] <= CLEAN * deviation[free]).all():
        return None
    return Estimated(np.maximum(noise, CLEAN * deviation), share)


def change(context: Context, new: Estimated) -> tuple[float, float]:
    """The largest change of the logarithm of a ratio of two channels' scales, and the standard deviation of the
    logarithm of the ratio of their estimated noises."""
    packed, before = context.packed(), context.problem().scaling.channel
    measured = np.flatnonzero((packed.weights > 0).any(axis=0))
    if not len(measured):
        return 0.0, 0.0
    ratio = np.log(context.scaled(new).channel / before)[measured]
    ends = measured[[int(np.argmax(ratio)), int(np.argmin(ratio))]]
    counted = np.maximum((packed.weights > 0).sum(axis=0) * new.share, 1.0)[ends]
    return float(ratio.max() - ratio.min()), float(np.sqrt(np.sum(0.5 / counted)))


def unsettled(context: Context, new: Estimated) -> bool:
    """Whether the new scales differ from the present ones noticeably, and by more than chance."""
    moved, sd = change(context, new)
    return moved > (max(NOTICED, CHANCE * sd) if context.estimated is None else SETTLED)


def share_of(residuals: Array, owner: Integers) -> float:
    """The share of residuals [m], in the order of time, that count: 1 unless the correlation of successive ones of the
    same trajectory is beyond chance."""
    correlation, pairs = autocorrelation_of(residuals, owner)
    if correlation is None or pairs < 2 or correlation <= 2 / np.sqrt(pairs):
        return 1.0
    length = len(residuals) / (len(residuals) - pairs)
    return max(share_that_counts(correlation, length), min(TOLD / len(residuals), 1.0))


def _used(engine: Engine, theta: Array, ridge: float) -> Array:
    """The degrees of freedom [C] that a fit has taken from each channel, under the ridge of greatest evidence."""
    problem, parameters = engine.problem, engine.parameters
    seen = problem.seen
    channel = np.broadcast_to(np.arange(seen.shape[1]), seen.shape)[seen]
    try:
        system = linearise(engine, theta)
        residuals = system.residuals.numpy()
        weak = WEAK * max(float(np.mean(residuals**2)), 1e-300)
        equations = NormalEquations(system, parameters, np.ones(len(residuals)), ridge, theta)
        for number in range(ROUNDS if ridge else 0):
            equations.ridge, _ = evidence(problem, equations, residuals, float("inf"), theta, equations.ridge, number)
        rng, out = np.random.default_rng([59]), np.zeros(seen.shape[1])
        for i in np.unique(channel):
            for _ in range(PROBES):
                probe = np.where(channel == i, rng.choice([-1.0, 1.0], size=len(channel)), 0.0)
                out[i] -= float(probe @ equations.times(equations.respond(probe, weak))) / PROBES
        return np.maximum(out, 0.0)
    except (np.linalg.LinAlgError, ComputationError):
        return np.zeros(seen.shape[1])
