"""The summary of a member whose model has random disturbances: predictions from row to row, and the likelihood."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gbspec.arrays import Array, Mask
from gbspec.backends import GeneratedModule
from gbspec.data import variance_of
from gbspec.files import finite
from gbspec.ir import linear_in_states
from gbspec.runs import (
    NORMAL_90,
    Certainties,
    ChannelRecord,
    Covariance,
    LikelihoodRecord,
    NoiseRecord,
    ObjectiveRecord,
    StageRecord,
    WhitenessRecord,
)
from gbspec.training.engines import GONE, Filtered, FilterEngine, filter, whiteness
from gbspec.training.optimise import at_maximum, widest
from gbspec.training.problem import Parameters, autocorrelation_of, in_time
from gbspec.training.recipe import (
    Context,
    filter_of,
    held_out_filter,
    step_fraction,
    step_of_drift,
    stiff_as_learned,
    whole_vector,
)
from gbspec.training.runs import certainties as of_squares
from gbspec.training.runs import summary
from gbspec.training.runs.small_noise import said_of_small_noises
from gbspec.training.runs.spread_below_zero import said_of_spreads
from gbspec.training.runs.summary import MemberResult

OBJECTIVE = "likelihood of innovations (Kalman filter)"
LAST, MEAN = "the last value before", "the mean of all values"
"""The predictors one row ahead that know no model."""


def summarise(
    context: Context,
    parameters: Parameters,
    theta: Array,
    freedom: float,
    seconds: float,
    stages: Sequence[StageRecord],
) -> MemberResult:
    """Evaluates a member at `theta`, with or without disturbances."""
    if not context.model.diffusions:
        return summary.summarise(context, parameters, theta, freedom, seconds, stages)
    engine = filter_of(context, parameters)
    vector = whole_vector(context, engine, theta)
    found, model = engine.filtered(vector), context.model
    problem, seen = engine.problem, engine.problem.valued
    log = engine.noise.log
    errors, ahead = filter.one_row_ahead(engine, found)
    with np.errstate(over="ignore", invalid="ignore"):
        natural = np.where(log, problem.packed.values * (np.exp(-errors) - 1), -errors)
    blown = seen & ~np.isfinite(found.error)
    rmse = {c.name: _root_mean_square(natural[ahead[:, i], i]) for i, c in enumerate(model.channels)}
    variances = engine.noise.variances(engine.layout.split(vector)[1])
    noise = {c.name: _root_mean_square(np.sqrt(variances[seen[:, i], i])) for i, c in enumerate(model.channels)}
    with torch.no_grad():
        constants = parameters.constants(torch.from_numpy(theta)).numpy()
    known, names = len(model.constants), [k.name for k in model.learnables]
    scaled = errors / context.scaled(None).channel
    loss = 0.5 * float(np.mean(scaled[ahead] ** 2)) if ahead.any() else 0.0
    own = constants[:, [known + i for i in parameters.own]]
    likelihood = _likelihood(engine, found, vector)
    told = [name for name, one in likelihood.noise.items() if one.interval is not None]
    return MemberResult(
        context.seed,
        loss,
        loss,
        _channels(context, parameters, theta, engine, found),
        rmse,
        noise,
        dict(zip(names, map(float, constants[:, known:].mean(axis=0)), strict=True)),
        {name: float("nan") for name in names},
        seconds,
        list(stages),
        _starts(engine, found, parameters, theta),
        list(context.packed().labels),
        sorted({problem.packed.labels[i] for i in problem.packed.row_trajectory[blown.any(axis=1)]}),
        own=own,
        own_sd=np.full(own.shape, np.nan),
        scales=None,
        objective=ObjectiveRecord(OBJECTIVE, likelihood.minus2ll),
        likelihood=likelihood,
        left=[
            *stiff_as_learned(context, problem, parameters, theta, 1.0, engine.row_states(found)[0]),
            *said_of_small_noises(engine, found, vector, told),
            *said_of_spreads(engine, found),
        ],
    )


def steps_of(context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]) -> dict[str, float | None]:
    """What a weights file says of steps: those of solutions, and of the filter where these are others."""
    found = context.steps(step_fraction(stages))
    if not context.model.diffusions or linear_in_states(context.model) is None or context.adaptive:
        return found
    return found | {"max_step": step_of_drift(context, parameters, theta), "filter_step": found["max_step"]}


def _root_mean_square(values: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _starts(engine: FilterEngine, found: Filtered, parameters: Parameters, theta: Array) -> Array:
    """The initial states as all measurements show them [N, n]; those that the model gives as it gives them."""
    with torch.no_grad():
        fixed = parameters.starts(torch.from_numpy(theta)).numpy()
    if not found.finite:
        return np.array(fixed, dtype=np.float64)
    smoothed = engine.coordinates.states(engine.smoothed_start(found))
    return np.where(engine.start_variance > 0, smoothed, fixed)


def _channels(
    context: Context, parameters: Parameters, theta: Array, engine: FilterEngine, found: Filtered
) -> dict[str, ChannelRecord]:
    """How predictions from row to row follow each channel's data, and held-out ones."""
    held = held_out_filter(context, parameters, theta) if len(context.held) else None
    scales, problem, out = context.scaled(None), engine.problem, {}
    errors, ahead = filter.one_row_ahead(engine, found)
    last = filter.last_values(engine)
    for i, channel in enumerate(context.model.channels):
        rows = in_time(problem, i)
        rows = rows[ahead[rows, i]]
        standard = found.error[rows, i] / np.sqrt(found.variance[rows, i])
        learned = context.estimated is not None and bool(np.isfinite(context.estimated.noise[i]))
        out[channel.name] = ChannelRecord(
            _r2(engine, errors, ahead, i),
            *_naive(engine, last, ahead, i),
            _held_r2(*held, i) if held is not None else None,
            len(rows),
            finite(float(scales.value_weights[i])),
            finite(float(context.estimated.noise[i])) if learned and context.estimated is not None else None,
            1.0 if learned else None,
            *autocorrelation_of(standard, problem.packed.row_trajectory[rows]),
        )
    return out


def _held_r2(engine: FilterEngine, found: Filtered, held: Mask, channel: int) -> float | None:
    errors, ahead = filter.one_row_ahead(engine, found)
    return _r2(engine, errors, ahead & held, channel)


def _r2(engine: FilterEngine, errors: Array, counted: Mask, channel: int) -> float | None:
    """1 minus the mean squared error of predictions from row to row over the variance of the values that count."""
    seen = counted[:, channel]
    variance = variance_of([engine.noise.value[seen, channel]])
    if not variance > 0:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        return finite(1 - float(np.mean(errors[seen, channel] ** 2)) / variance)


def _naive(engine: FilterEngine, last: Array, counted: Mask, channel: int) -> tuple[float | None, str]:
    """R² of the better predictor one row ahead that knows no model: the channel's last value, or the mean of all values
    that count; and what it is."""
    seen = counted[:, channel]
    values, before = engine.noise.value[seen, channel], last[seen, channel]
    mean = float(np.mean(values)) if len(values) else 0.0
    found = _r2(engine, engine.noise.value - np.where(np.isfinite(last), last, mean), counted, channel)
    if found is None or not np.isfinite(before).any():
        return found, "" if found is None else MEAN
    return (found, LAST) if found > 0 else (0.0, MEAN)


def _likelihood(engine: FilterEngine, found: Filtered, vector: Array) -> LikelihoodRecord:
    """The likelihood, its criteria, the learned noises with intervals, and tests of the innovations."""
    count, values = _fitted(engine), int(engine.problem.valued.sum())
    minus2, maximum = finite(2 * found.value), at_maximum(engine, vector, found)
    least = None if maximum.value is None else finite(2 * maximum.value)
    model, noise = engine.problem.model, {}
    deviations = filter.deviations(engine, vector, found) if found.finite else np.full(len(vector), np.nan)
    _, log_sd = engine.layout.split(vector)
    for place, channel in enumerate(engine.noise.learned):
        value, sd = float(np.exp(log_sd[place])), finite(float(deviations[engine.parameters.size + place]))
        known = sd is not None and sd < GONE and channel not in maximum.unbounded
        interval = (value * np.exp(-NORMAL_90 * (sd or 0)), value * np.exp(NORMAL_90 * (sd or 0))) if known else None
        noise[model.channels[channel].name] = NoiseRecord(value, sd, interval)
    return LikelihoodRecord(
        OBJECTIVE,
        minus2,
        count,
        values,
        None if least is None else least + 2 * count,
        None if least is None else least + count * float(np.log(max(values, 1))),
        noise,
        _whiteness(engine, found),
        least,
        unbounded=tuple(model.channels[i].name for i in maximum.unbounded) or None,
    )


def _fitted(engine: FilterEngine) -> int:
    """The number of entries of the vector that are fitted, without those of splines that nothing depends on."""
    weights = sum(network.parameters for network in engine.problem.model.networks)
    return int(engine.layout.free[engine.parameters.n_weights :].sum()) + weights


def _whiteness(engine: FilterEngine, found: Filtered) -> dict[str, WhitenessRecord]:
    out = {}
    for i, channel in enumerate(engine.problem.model.channels):
        tested = whiteness(engine.standardised(found, i)) if found.finite else None
        if tested is not None:
            out[channel.name] = WhitenessRecord(
                tested.values,
                len(tested.autocorrelations),
                finite(tested.ljung_box),
                finite(tested.p),
                finite(tested.distance),
                finite(tested.distance_p),
                finite(tested.robust_p),
            )
    return out


def certainties(
    context: Context, parameters: Parameters, theta: Array, stages: Sequence[str], member: GeneratedModule
) -> Certainties:
    """The certainty of a finished fit; with disturbances and unknown functions there is no covariance."""
    if not context.model.diffusions:
        return of_squares.certainties(context, parameters, theta, stages, member)
    engine = filter_of(context, parameters)
    vector = whole_vector(context, engine, theta)
    found = engine.filtered(vector)
    support = of_squares.support_of(engine.problem, parameters, theta, engine.row_states(found), member)
    known = None if parameters.n_weights or not found.finite else _of_constants(engine, vector, found)
    return Certainties(known, support)


def _of_constants(engine: FilterEngine, vector: Array, found: Filtered) -> Covariance | None:
    """The covariance of the constants that trajectories share, with all else integrated out; None where the data say
    nothing of one of them."""
    parameters, count = engine.parameters, len(engine.parameters.shared)
    places = slice(parameters.n_weights, parameters.n_shared)
    slopes = parameters.bijections(parameters.shared).derivative(vector[places])
    conditional = slopes[:, None] * filter.covariance(engine, vector, found)[places, places] * slopes
    if not np.isfinite(conditional).all():
        return None
    size = np.sqrt(np.maximum(np.diag(conditional), 1e-300))
    share = np.minimum(1.0, widest(parameters, vector) / size)
    return Covariance(
        names=(),
        constants=tuple(parameters.model.learnables[i].name for i in parameters.shared),
        spread=0.0,
        vectors=np.zeros((0, 0)),
        shares=np.zeros(0),
        coupling=np.zeros((count, 0)),
        conditional=share[:, None] * conditional * share,
    )
