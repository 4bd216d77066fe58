"""The summary of a fitted member: errors by channel, noise, initial states, standard deviations of the constants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import fdtrc

from gbspec.arrays import Array
from gbspec.data import Scales, naive_predictors, present_values, said_of_ranges, states_beyond, variance_of
from gbspec.files import finite
from gbspec.ir import LEAST_PREDICTED, ErrorScale, Model, error_scales
from gbspec.runs import ChannelRecord, LikelihoodRecord, ObjectiveRecord, PopulationRecord, StageRecord
from gbspec.training.engines import Moments, predicted, residual_table, residual_vector
from gbspec.training.problem import (
    Parameters,
    Problem,
    autocorrelation_of,
    in_time,
    judged_residuals,
    limited,
    mean_loss,
    measured_only,
    residuals_of,
)
from gbspec.training.recipe import (
    Context,
    astray,
    held_out_solutions,
    step_fraction,
    stiff_as_learned,
    unstable_as_learned,
)
from gbspec.training.runs.moved_starts import moved_starts
from gbspec.training.runs.naming import labelled
from gbspec.training.runs.negative_states import negative_states
from gbspec.training.runs.outlying import Outlying, outlying_rows
from gbspec.training.runs.stated import to_stated_noise
from gbspec.training.runs.verdict import not_followed
from gbspec.training.stages import StageName

REPLICATED = 3
"""So many degrees of freedom of replicates say how large the error of measurement is."""


@dataclass
class MemberResult:
    """A member's part of `fit.json`; arrays in natural units.

    `loss` of whole solutions, `interval_loss` of predictions from each row to the next; by channel: how whole solutions
    follow the data (`channels`), root mean square of prediction minus value of the autoregressive solution (`rmse`, NaN
    if it is not finite), and the estimated standard deviation of the `noise`; `constants` by name; `sd` by name (NaN:
    not known); `correlations` [k, k] of the constants that all trajectories share, empty where not known; `failed`
    names the trajectories whose autoregressive solution is not finite. `scales` are those of the residuals, if their
    noise was estimated. `own` and `own_sd` [N, j] are the constants per trajectory and their standard deviations (NaN:
    not known). `left` is said of whole solutions, `beyond` of states that leave their declared ranges, `tied` of
    constants and spreads that the data do not tell.
    """

    seed: int
    loss: float
    interval_loss: float
    channels: dict[str, ChannelRecord]
    rmse: dict[str, float]
    noise: dict[str, float]
    constants: dict[str, float]
    sd: dict[str, float]
    seconds: float
    stages: list[StageRecord]
    initial: Array
    labels: list[str]
    failed: list[str] = field(default_factory=list)
    history: list[tuple[str, int, float, float, tuple[float, ...]]] = field(default_factory=list)
    finished: bool = True
    notes: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    beyond: list[str] = field(default_factory=list)
    tied: list[str] = field(default_factory=list)
    correlations: Array = field(default_factory=lambda: np.zeros((0, 0)))
    own: Array = field(default_factory=lambda: np.zeros((0, 0)))
    own_sd: Array = field(default_factory=lambda: np.zeros((0, 0)))
    scales: Scales | None = None
    population: PopulationRecord | None = None
    objective: ObjectiveRecord | None = None
    likelihood: LikelihoodRecord | None = None
    freedom: float | None = None
    """Degrees of freedom of the residuals from which the noise was estimated; None where it was not, or not known."""
    tabled: dict[str, float] = field(default_factory=dict)
    """Of channels with values that have standard deviations in the table: how many times as large residuals are."""
    outlying: dict[str, Outlying] = field(default_factory=dict)
    """Where channels have residuals that are far from all others, and leave most of the sum of squares."""
    vanished: frozenset[str] = frozenset()
    """Learned constants of noises that vanish where the model has values exactly, which makes a likelihood infinite."""
    bounded: frozenset[str] = frozenset()
    """Shared constants that ended at bounds,"""
    tied_to_bounds: frozenset[str] = frozenset()
    """and those that have no interval since they follow from these."""
    misjudged: frozenset[str] = frozenset()
    """Constants without a standard deviation since the curvature leaves them open and the data do not."""
    misjudged_own: frozenset[tuple[str, str]] = frozenset()
    """The same of constants of single trajectories, with the labels of these,"""
    open_own: frozenset[tuple[str, str]] = frozenset()
    """those that the data leave open too, as a test found,"""
    bounded_own: frozenset[tuple[str, str]] = frozenset()
    """and those that ended at bounds."""
    at_most: dict[str, float] = field(default_factory=dict)
    """Standard deviations with which constants whose curvature is no measure count in predictions, which need finite
    ones; 0: as known."""
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Intervals of constants by the likelihood, where those of the curvature say nothing."""
    untested: frozenset[str] = frozenset()
    """Constants that the curvature leaves open between their bounds; whether the data do was not tested, or not found
    with as many fits as may be made."""


def summarise(
    context: Context,
    parameters: Parameters,
    theta: Array,
    freedom: float,
    seconds: float,
    stages: Sequence[StageRecord],
) -> MemberResult:
    """Evaluates a member at `theta`; `freedom`: the degrees of freedom that its last stage used (NaN: not known)."""
    model = context.model
    fraction = step_fraction([stage.name for stage in stages])
    engine = context.engine(parameters, 0.0, fraction)
    problem, solution = engine.problem, predicted(engine, theta)
    with torch.no_grad():
        constants = parameters.constants(torch.from_numpy(theta))
    blown = problem.seen & ~np.isfinite(solution.mean)
    failed = sorted({problem.packed.labels[i] for i in problem.packed.row_trajectory[blown.any(axis=1)]})
    noise_of = _Noise.of(context, parameters, theta, freedom, [stage.name for stage in stages])
    rmse, noise = _errors(model, problem, solution.mean, noise_of)
    learned_values = constants.numpy()[:, len(model.constants) :]
    values, own = learned_values.mean(axis=0), learned_values[:, list(parameters.own)]
    names = [k.name for k in model.learnables]
    learned = dict(zip(names, map(float, values), strict=True))
    scales = error_scales(model, learned)
    followed = _channels(context, parameters, theta, problem, solution.mean, fraction, scales)
    judged = judged_residuals(problem, solution.mean, scales)
    outlying = outlying_rows(model, problem, judged, context.trajectories.items, bool(context.start_free.any()))
    tabled = _beside_tabled(noise_of, problem, model)
    channels = _beside_noise(problem, followed, noise_of, outlying)
    if noise_of.share is not None:  # the noise is that of residuals of whole solutions
        channels |= to_stated_noise(model, channels, _beside_stated(noise_of, problem, model), noise_of.freedom)
    lost = bool(failed) or any(one.r2 is None or not_followed(one) for one in channels.values())
    return MemberResult(
        context.seed,
        mean_loss(measured_only(problem, residuals_of(problem, solution.mean))),
        mean_loss(residual_vector(context.engine(parameters, 1.0, fraction), theta)),
        channels,
        rmse,
        noise,
        learned,
        {name: float("nan") for name in names},
        seconds,
        list(stages),
        solution.initial.copy(),
        list(context.packed().labels),
        failed,
        left=[
            *(unstable_as_learned(context, parameters, theta) if lost else []),
            *only_at_its_step(context, parameters, theta, fraction, failed),
            *stiff_as_learned(context, problem, parameters, theta, fraction, solution.before),
            *moved_starts(model, problem, solution.initial, noise),
        ],
        beyond=_beyond(model, solution, noise),
        own=own,
        own_sd=np.full(own.shape, np.nan),
        scales=None if context.estimated is None else context.scaled(context.estimated),
        freedom=None if model.marginal else noise_of.freedom,
        tabled=tabled,
        outlying=outlying,
    )


def _beside_noise(
    problem: Problem,
    followed: Mapping[str, ChannelRecord],
    noise_of: _Noise,
    outlying: Mapping[str, Outlying],
) -> dict[str, ChannelRecord]:
    """The records of channels with what replicates and outliers say of their noise."""
    lacking = (noise_of.lack_of_fit(column, i) for i, column in enumerate(problem.valued.T))
    return {
        name: replace(one, lack_of_fit=p, outliers=outlying[name].rows if name in outlying else None)
        for (name, one), p in zip(followed.items(), lacking, strict=True)
    }


def _errors(model: Model, problem: Problem, mean: Array, noise_of: _Noise) -> tuple[dict[str, float], dict[str, float]]:
    """Root mean square errors of whole solutions, and standard deviations of the noise, by channel."""
    rmse, noise = {}, {}
    difference, seen = mean - problem.packed.values, problem.valued
    for i, channel in enumerate(model.channels):
        column = difference[seen[:, i], i]
        with np.errstate(over="ignore", invalid="ignore"):
            rmse[channel.name] = float(np.sqrt(np.mean(column**2))) if len(column) else float("nan")
        share = 1.0 if problem.scaling.share is None else float(problem.scaling.share[i])
        noise[channel.name] = noise_of.deviation(seen[:, i], i) * float(problem.scaling.channel[i]) * share**0.5
    return rmse, noise


def _beyond(model: Model, solution: Moments, noise: Mapping[str, float]) -> list[str]:
    """A sentence of the states whose solutions lie far outside of their declared ranges, one of those of which the
    initial values alone do, and one of each that is declared from zero and goes below."""
    negative = negative_states(model, solution, noise)
    every = (states_beyond(model, np.where(np.isfinite(a), a, np.nan)) for a in (solution.after, solution.initial))
    solutions, starts = ([one for one in each if one.most > 0 or one.name not in negative] for each in every)
    names = {one.name for one in solutions}
    return [
        f"in the learned {what}, {text}"
        for what, found in (("solutions", solutions), ("initial states", [s for s in starts if s.name not in names]))
        for text in said_of_ranges(found)
    ] + [*negative.values()]


def _beside_tabled(noise: _Noise, problem: Problem, model: Model) -> dict[str, float]:
    """The root mean square, by channel, of residuals over their standard deviations, with the degrees of freedom that
    are left, where the table has such deviations: reduced chi-square's root (Bevington and Robinson, Data Reduction
    and Error Analysis for the Physical Sciences, 2003, 6.4), outliers limited as in the noise."""
    levels, found = problem.scaling.levels, {}
    for i, channel in enumerate(model.channels):
        seen = problem.seen[:, i]
        own = seen & (np.nan_to_num(problem.packed.sd[:, i]) > 0)
        if levels is not None and levels[i] > 0 and own.any():
            found[channel.name] = noise.deviation(problem.valued[:, i] & own, i) / float(levels[i])
    return found


def _beside_stated(noise: _Noise, problem: Problem, model: Model) -> dict[str, float]:
    """The same of all values of the channels of which each has a standard deviation, by the table or by the model."""
    levels, found = problem.scaling.levels, {}
    for i, channel in enumerate(model.channels):
        seen, stated = problem.valued[:, i], channel.noise
        of_model = stated is not None and stated.value is None and stated.scale > 0
        own = np.nan_to_num(problem.packed.sd[seen, i]) > 0
        if levels is not None and levels[i] > 0 and len(own) and (of_model or own.all()):
            found[channel.name] = noise.deviation(seen, i) / float(levels[i])
    return found


def only_at_its_step(
    context: Context, parameters: Parameters, theta: Array, fraction: float, failed: Sequence[str]
) -> list[str]:
    """A sentence if solutions blow up at half the solver's step: such a fit uses the error of its steps.

    Nothing is said of trajectories that `failed` at the step of the fit.
    """
    if context.adaptive or context.model.marginal or context.model.diffusions:
        return []
    now, half = (context.engine(parameters, 0.0, part) for part in (fraction, fraction / 2))
    blown, packed = astray(half, theta) & ~astray(now, theta), half.problem.packed
    labels = {packed.labels[i] for i in packed.row_trajectory[blown.any(axis=1)]} - set(failed)
    if not labels:
        return []
    listed = labelled(sorted(labels))
    return [
        f"at half the solver's step ({context.max_step * fraction / 2:.3g}) solutions of {listed} blow up or are far "
        "from the data: the fit follows them by the error of its steps. Do not rely on it; fit again with a smaller "
        "`--max-step`"
    ]


def _channels(
    context: Context,
    parameters: Parameters,
    theta: Array,
    problem: Problem,
    mean: Array,
    fraction: float,
    judged: Sequence[ErrorScale],
) -> dict[str, ChannelRecord]:
    """How whole solutions follow each channel's data, and those of held-out trajectories, on the scales of errors."""
    present = present_values(context.model, context.trajectories, context.absent)
    naive = naive_predictors(context.model, present, judged)
    held = held_out_solutions(context, parameters, theta, fraction)
    estimated, scales = context.estimated, context.scaled(context.estimated)
    residuals = judged_residuals(problem, mean, judged)
    out = {}
    for i, channel in enumerate(context.model.channels):
        rows, known = in_time(problem, i), naive.get(channel.name)
        out[channel.name] = ChannelRecord(
            _r2(problem, mean, i, judged[i]),
            finite(known.r2) if known is not None else None,
            known.predictor if known is not None else "",
            _r2(*held, i, judged[i]) if held is not None else None,
            int(problem.seen[:, i].sum()),
            finite(float(scales.value_weights[i])),
            None if estimated is None else finite(float(estimated.noise[i])),
            None if estimated is None else float(estimated.share[i]),
            *autocorrelation_of(residuals[rows, i], problem.packed.row_trajectory[rows]),
            censored=limits_of(problem, i),
            averages=averages_of(problem, i),
        )
    return out


def limits_of(problem: Problem, channel: int) -> int | None:
    """How many measured values of a channel are limits; None if none are."""
    return int((problem.seen & ~problem.valued)[:, channel].sum()) or None


def averages_of(problem: Problem, channel: int) -> int | None:
    """How many values of a channel are averages of replicates; None if none are."""
    return int((problem.valued & (problem.packed.weights > 1.0))[:, channel].sum()) or None


def _r2(problem: Problem, mean: Array, channel: int, scale: ErrorScale) -> float | None:
    """1 minus the mean squared error of a channel's predictions over the variance of its data, on its scale."""
    seen, packed = problem.valued[:, channel], problem.packed
    values = scale.measured(packed.values[seen, channel])
    predictions = scale.predicted(mean[seen, channel], LEAST_PREDICTED, packed.weights[seen, channel] ** 2)
    variance = variance_of([values])
    if not variance > 0:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        return finite(1 - float(np.mean((predictions - values) ** 2)) / variance)


@dataclass(frozen=True)
class _Noise:
    """Residuals [R, C], in units of the channels' scales, from which the noise is estimated.

    If the data are noisy, or only constants are learned, whole solutions were fitted: the noise variance is then the
    mean squared residual, divided by the `share` of the degrees of freedom that the fit has not used. Where all forms
    are known this is the s² of the constants' standard deviations; beside networks outliers are limited (`limits`).
    Otherwise each value was predicted from the previous one, and the noise is estimated from the median. `freedom` are
    those that are left, of the values as much as each counts; None where those used are not known.
    `replicates` are the sums of squares and degrees of freedom [C] of what replicates differ by from their averages.
    """

    residuals: Array
    share: float | None
    freedom: float | None
    replicates: tuple[Array, Array]
    limits: bool = True

    @classmethod
    def of(
        cls, context: Context, parameters: Parameters, theta: Array, freedom: float, stages: Sequence[str]
    ) -> _Noise:
        """The noise from the residuals at `theta`, with the forcing of the training."""
        whole = whole_solutions(context, parameters, stages)
        engine = context.engine(parameters, 0.0 if whole else context.options.blend, step_fraction(stages))
        residuals, share = residual_table(engine, theta), engine.problem.scaling.share
        residuals = residuals if share is None else residuals / np.sqrt(share)
        values = engine.problem.noise_terms(residual_vector(engine, theta))[1]
        count, counted = float(np.sum(values / engine.problem.shares)), float(values.sum())
        replicates = engine.problem.replicates
        if context.model.marginal:  # differences between trajectories are no lack of the model
            replicates = (np.zeros_like(replicates[0]), np.zeros_like(replicates[1]))
        left = max(counted - freedom, 0.1 * counted, 1.0) + replicates[1].sum() if np.isfinite(freedom) else None
        if not whole or not count:
            return cls(residuals, None, left, replicates)
        used = freedom if np.isfinite(freedom) else float(parameters.free[parameters.n_weights :].sum())
        limits = bool(parameters.n_weights)
        return cls(residuals, max(1 - used / count, 0.1, 1 / count), left, replicates, limits)

    def deviation(self, seen: NDArray[np.bool_], channel: int) -> float:
        """The standard deviation of a channel's noise."""
        column = self.residuals[seen, channel]
        column = column[np.isfinite(column)]
        if self.share is None or not len(column):
            return _robust_deviation(column)
        scatter, more = (part[channel] for part in self.replicates)
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.sum((limited(column) if self.limits else column) ** 2) + scatter
            return float(np.sqrt(squares / (len(column) * self.share + more)))

    def lack_of_fit(self, seen: NDArray[np.bool_], channel: int) -> float | None:
        """The probability that averages differ from the solutions by so much more than replicates from each other, if
        these have the whole error of measurement and the model is right: an F test (Draper and Smith, Applied
        Regression Analysis, 1998, 2.1). None where there are hardly any replicates, or whole solutions were not fitted.
        """
        column, (scatter, more) = self.residuals[seen, channel], (part[channel] for part in self.replicates)
        if self.share is None or more < REPLICATED or not scatter > 0 or not np.isfinite(column).all():
            return None
        left = max(len(column) * self.share, 1.0)
        return float(fdtrc(left, more, np.sum(column**2) / left / (scatter / more)))


def whole_solutions(context: Context, parameters: Parameters, stages: Sequence[str]) -> bool:
    """Whether whole solutions were fitted in the end, rather than each value from the previous one."""
    asked = (context.options.forcing, context.options.method) == ("teacher", "auto")
    fitted = not parameters.n_weights or parameters.model.marginal or StageName.AUTOREGRESSIVE in stages
    return asked and fitted


def _robust_deviation(residuals: Array) -> float:
    """1.4826 times the median absolute residual: the standard deviation, robust against outliers."""
    finite = residuals[np.isfinite(residuals)]
    return 1.4826 * float(np.median(np.abs(finite))) if len(finite) else float("nan")
