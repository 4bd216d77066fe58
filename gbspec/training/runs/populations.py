"""The population part of a member's result: from the maximum of the marginal likelihood to records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.files import finite
from gbspec.ir import NOISES, Distribution, Model
from gbspec.runs import Covariance, EffectRecord, ErrorsRecord, ObjectiveRecord, PopulationRecord, PopulationTables
from gbspec.training.population import (
    Objective,
    PopulationResult,
    examined,
    learned_groups,
    modes_of,
    result_at,
    simulated_tables,
)
from gbspec.training.problem import Parameters
from gbspec.training.recipe import Context, marginal_objective
from gbspec.training.runs.misjudged import misjudged_of_population
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.tied import SHOWN, TIED, said_of_tied, without_tied
from gbspec.training.runs.unmoved import unmoved

EXACTLY = 1e-6
"""A noise below this part of a channel's largest one is none."""

VANISHED = 1e-3
"""A spread of logarithms (of logits; relative to the start of a normal one) below this is none."""

NONE, OPEN, TOLD = 1e-5, 0.1, 2.706
"""A spread is compared with one of this size, which is none, where its interval reaches below a tenth of it. Data do
not tell it apart from none if -2 log likelihood is higher by less than the last number without it: the 95 % point, as
a spread cannot be negative (Self and Liang 1987)."""

UNLIKE = 1e-3
"""Prediction errors that chance would give in fewer fits than this are not those of the model."""


@dataclass(frozen=True)
class Described:
    """A population as the run keeps it."""

    record: PopulationRecord
    objective: ObjectiveRecord
    tables: PopulationTables
    info: dict[str, object]
    covariance: Covariance | None


def with_population(
    result: MemberResult,
    context: Context,
    parameters: Parameters,
    theta: Array,
    begun: Sequence[str],
    ridge: float,
    maximum: bool,
    held: bool,
) -> tuple[MemberResult, Described]:
    """A member's result with what the marginal likelihood tells: medians, deviations, individual estimates.
    `begun`: the names of the stages that led to `theta`. Where no stage ended at a `maximum`, nothing says how well
    constants are known, and nothing is simulated. `held`: held-out data chose `theta` on the way to a maximum."""
    objective = marginal_objective(context, parameters, begun)
    layout = objective.layout
    modes = modes_of(parameters, objective.marginal.likelihood, theta)
    found = result_at(objective, theta[: parameters.n_weights], theta[layout.slice()], modes, ridge, maximum)
    known, own = found.estimates, [k.name for k in context.model.learnables if k.per_trajectory]
    constants, sd = dict(result.constants), dict(result.sd)
    for learnable in context.model.learnables:
        made = learnable.distribution
        name = learnable.name if made is None else made.median
        if not name:
            constants[learnable.name] = 0.0
        elif name in known.names:
            constants[learnable.name] = float(known.value[known.at(name)])
            sd[learnable.name] = float(known.sd[known.at(name)])
    still = unmoved(context.model, constants, dict(result.sd) | sd, begun) if maximum else []
    found = replace(found, used=found.used - len(still))  # they are no parameters of the fit
    shared = [known.at(k.name) for k in context.model.learnables if not k.per_trajectory]
    order = [k.name for k in layout.distributed]
    pick = [order.index(name) for name in own]
    made_result = replace(
        result,
        constants=constants,
        sd=sd,
        correlations=_correlations(known.covariance[np.ix_(shared, shared)]) if maximum else np.zeros((0, 0)),
        own=found.individual[:, pick],
        own_sd=found.individual_sd[:, pick],
        noise=_noise(context, found, objective),
    )
    tables, errors = _tables(context, found, objective, maximum), dict[str, ErrorsRecord]()
    if maximum:
        made_result.tied += _without_tied(made_result, context, parameters, theta, begun, found)
        made_result.tied += misjudged_of_population(made_result, objective, found)
        errors = _errors(context, tables)
        made_result.vanished, infinite = _unbounded(context, found, tables)
        spreads = [*_vanished(objective, found), *_doubtful(objective, found)]
        made_result.left += [*infinite, *said_of_errors(errors, context.model)]
        made_result.tied += spreads
    return made_result, Described(
        replace(_record(context, found, objective, maximum and not held), npde=errors, held=maximum and held),
        _objective(found, objective),
        tables,
        _info(objective, found),
        found.shared,
    )


def _without_tied(
    result: MemberResult,
    context: Context,
    parameters: Parameters,
    theta: Array,
    begun: Sequence[str],
    found: PopulationResult,
) -> list[str]:
    """Takes their intervals from constants that follow from another one's bound; what is to be said of them."""
    tied = {name: factor for name, factor in found.loosened.items() if factor > TIED and name in result.sd}
    result.sd |= dict.fromkeys(tied, math.nan)
    said = []
    if _one_sum_of_squares(context.model):
        said = without_tied(result, context, parameters, theta, begun, tied)
    if any(f"`{name}`" in text for text in said for name in tied):
        return said
    ended = [name for name, one in found.loosened.items() if math.isnan(one)]
    return [*said_of_tied(tied, ended, SHOWN), *said]


def _one_sum_of_squares(model: Model) -> bool:
    """Whether the likelihood has its maximum where a sum of squares has its minimum: all trajectories have the same
    constants, and the one channel has a noise of one size, which is learned."""
    if model.distributed or len(model.channels) != 1:
        return False
    noise = model.channels[0].noise
    return noise is not None and not NOISES[noise.kind].density and noise.value is not None and noise.value.is_Symbol


def _vanished(objective: Objective, found: PopulationResult) -> list[str]:
    """A warning for each learned spread that ended at zero."""
    return [
        f"the spread of `{name}` between values of `{column}` ended at zero: these data show no such differences, and "
        "each has the median. Too few values of each, a wrong noise, or a model that lacks something hide them as well"
        for name, column, place, size in _spreads(objective, found)
        if found.estimates.value[place] < VANISHED * size
    ]


def _spreads(objective: Objective, found: PopulationResult) -> list[tuple[str, str, int, float]]:
    """The constant, the column, the place among the estimates and the unit of each learned spread."""
    out = []
    for learnable in objective.layout.distributed:
        made = learnable.distribution
        assert made is not None
        columns = ("trajectory", *(level.column for level in made.levels))
        size = (abs(learnable.start) or 1.0) if made.kind == "normal" else 1.0
        each = zip(columns, made.spreads, strict=True)
        out += [
            (learnable.name, column, found.estimates.at(name), size) for column, (name, _) in each if name is not None
        ]
    return out


def _unbounded(context: Context, found: PopulationResult, tables: PopulationTables) -> tuple[frozenset[str], list[str]]:
    """The constants of noises that vanish at some values, which the model then has exactly, and a warning for each
    channel with such values: its likelihood grows without limit."""
    names, out = set(), []
    for i, channel in enumerate(context.model.channels):
        rows = np.flatnonzero(tables.arrays["channel"] == i)
        sd = found.noise[rows]
        largest = float(sd.max(initial=0.0))
        exact = rows[sd < EXACTLY * largest]
        if not len(exact) or channel.noise is None or channel.noise.value is None:
            continue
        if NOISES[channel.noise.kind].counts:  # probabilities are at most 1
            continue
        symbols = {symbol.name for symbol in channel.noise.value.free_symbols} & set(found.estimates.names)
        gone = [name for name in sorted(symbols) if abs(_estimate(found, name)) < EXACTLY * largest]
        names |= set(gone)
        at = zip(tables.arrays["owner"][exact[:3]], tables.arrays["time"][exact[:3]], strict=True)
        first = ", ".join(f"`{tables.labels[int(owner)]}` at {time:g}" for owner, time in at)
        out.append(
            f"the likelihood has no maximum: the noise of {len(exact)} values of `{channel.name}` ({first}"
            f"{', ...' if len(exact) > 3 else ''}) went to zero, since the model has these values exactly, as a 0 "
            "before a first dose; -2 log likelihood, constants and intervals mean nothing. Leave these values empty, "
            f"write them as limits (`<0.1`), or give {', '.join(f'`{name}`' for name in gone) or 'the noise'} a lower "
            "bound above zero"
        )
    return frozenset(names), out


def _estimate(found: PopulationResult, name: str) -> float:
    return float(found.estimates.value[found.estimates.at(name)])


def _doubtful(objective: Objective, found: PopulationResult) -> list[str]:
    """A warning for each learned spread that the data do not tell apart from none: its interval, which is that of its
    logarithm, may cover several powers of ten."""
    out, known = [], found.estimates
    distributions = {k.name: k.distribution for k in objective.layout.distributed}
    for name, column, place, size in _spreads(objective, found):
        value, low, high = (float(of[place]) for of in (known.value, known.low, known.high))
        if value < VANISHED * size or not low < OPEN * value:
            continue
        rise = _without(objective, found, place, NONE * size) - found.point.objective
        if rise < TOLD:
            out.append(
                f"the spread of `{name}` between values of `{column}`, {value:.3g}, is not told apart from none by "
                f"these data: without it -2 log likelihood is higher by {max(rise, 0.0):.2g} only (2.7 would tell), "
                f"and its interval, {low:.3g} to {high:.3g}, says nothing. {left_out(distributions[name], column)}, or "
                "measure more"
            )
    return out


def left_out(made: Distribution | None, column: str) -> str:
    """What to leave out of the statement of a constant that does not differ between values of a column."""
    if made is None:
        return "Leave the distribution out"
    columns = ("trajectory", *(level.column for level in made.levels))
    differ = (name for name, (spread, fixed) in zip(columns, made.spreads, strict=True) if spread or fixed)
    kept = [name for name in differ if name != column]
    if not kept:
        return "Leave the distribution out"
    rest = " and ".join(f"`per {name}`" for name in kept)
    return f"Leave `per {column}` with its distribution out ({rest} can stay)"


def _without(objective: Objective, found: PopulationResult, place: int, none: float) -> float:
    """The objective where the spread at a place of u is `none`, after a scoring step of the other parameters."""
    point, layout = found.point, objective.layout
    u = point.u.copy()
    natural = layout.natural(torch.from_numpy(u)).numpy().copy()
    natural[place] = none
    u[place] = layout.bijections.from_natural(natural)[place]
    without = objective.at(point.weights, u, point.z, found.ridge, afresh=True)
    if not np.isfinite(without.objective):
        return float("inf")
    count = len(point.weights)
    rest = np.setdiff1d(np.arange(count + len(u)), [count + place])
    curvature = objective.curvature(without, found.ridge)[np.ix_(rest, rest)]
    step = np.zeros(count + len(u))
    step[rest] = -np.linalg.pinv(curvature, hermitian=True) @ objective.gradient(without, found.ridge)[rest]
    moved = objective.at(point.weights + step[:count], u + step[count:], without.z, found.ridge)
    return float(np.fmin(without.objective, moved.objective))


def _errors(context: Context, tables: PopulationTables) -> dict[str, ErrorsRecord]:
    """The tests of prediction errors, channel by channel."""
    out = {}
    for i, channel in enumerate(context.model.channels):
        found = examined(tables.arrays["npde"][tables.arrays["channel"] == i])
        if found is not None:
            out[channel.name] = ErrorsRecord(found.n, found.mean, found.variance, found.p)
    return out


def said_of_errors(errors: Mapping[str, ErrorsRecord], model: Model) -> list[str]:
    """A warning for each channel whose values are not distributed as the model says."""
    kinds = {channel.name: "" if channel.noise is None else channel.noise.kind for channel in model.channels}
    other = {name: _OTHER.get(kinds.get(name, ""), _PROPORTIONAL) for name in errors}
    return [
        f"the values of `{name}` are not distributed as the model says: their prediction errors have the mean "
        f"{one.mean:.2g} and the variance {one.variance:.3g} (0 and 1 if it were right; p = {one.p:.1g}). See `gbspec "
        f"plot RUN prediction-errors` and `predictive-check`; what differs may be the noise{other[name]}, a "
        "distribution, a known term, or the fit itself: compare other seeds (`--seed`)"
        for name, one in errors.items()
        if one.p is not None and one.p < UNLIKE
    ]


_PROPORTIONAL = " (one part in proportion to the value: `noise normal(sqrt(a^2 + (b*y)^2))`)"
_WIDER = " (counts that vary more than Poisson's: `noise negative_binomial(k)` with `learn k = 10 in [0.1, 1e4]`)"
_OTHER: Mapping[str, str] = {"poisson": _WIDER, "negative_binomial": ""}
"""What noise may be written in place of one."""


def _info(objective: Objective, found: PopulationResult) -> dict[str, object]:
    """What the weights file says of the distribution: the names, and the factor B of the deviations' covariance, in
    which those of groups are part, as of trajectories of unseen groups. With groups also the factor of what is not
    shared, for each shared deviation the place of its constant, the column, and the standard deviation, and what is
    known of the groups of the data (`learned`)."""
    layout = objective.layout
    with torch.no_grad():
        factor = layout.factor(layout.natural(torch.from_numpy(found.point.u))).numpy()
    more: dict[str, object] = {}
    if layout.levels:
        width = len(layout.distributed)
        shared = [(k, level.column, float(factor[k, width + j])) for j, (k, level) in enumerate(layout.levels)]
        learned = learned_groups(objective, found.point)
        more = {"own": factor[:, :width].tolist(), "groups": shared, "learned": learned}
        values, vectors = np.linalg.eigh(factor @ factor.T)
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
    return {"names": [k.name for k in layout.distributed], "factor": factor.tolist(), **more}


def _correlations(covariance: Array) -> Array:
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(covariance / np.outer(sd, sd), dtype=np.float64)


def _noise(context: Context, found: PopulationResult, objective: Objective) -> dict[str, float]:
    """The noise of each channel: the root mean square of its standard deviations."""
    channel = objective.marginal.predictions.measured.channel
    out = {}
    for i, one in enumerate(context.model.channels):
        values = found.noise[channel == i]
        out[one.name] = float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
    return out


def _record(context: Context, found: PopulationResult, objective: Objective, maximum: bool) -> PopulationRecord:
    effects = _effects(objective, found)
    names = [learnable.name for learnable in objective.layout.distributed]
    correlations = {
        a: {b: float(found.correlation[i, j]) for j, b in enumerate(names) if j != i and found.correlation[i, j] != 0}
        for i, a in enumerate(names)
    }
    likelihood = objective.marginal.likelihood
    values = len(likelihood.value) + float(likelihood.more.sum())  # replicates count as values of their own
    of_likelihood = maximum and all(k.prior is None for k in context.model.learnables)
    return PopulationRecord(
        finite(found.point.minus2ll),
        effects,
        {name: row for name, row in correlations.items() if row},
        found.used,
        finite(found.point.minus2ll + 2 * found.used) if of_likelihood else None,
        finite(found.point.minus2ll + found.used * float(np.log(max(values, 1)))) if of_likelihood else None,
        objective.marginal.nodes,
        found.ridge if context.model.networks else None,
        exact_hessian=finite(found.exact),
        maximum=maximum,
    )


def _effects(objective: Objective, found: PopulationResult) -> dict[str, EffectRecord]:
    """The distributions: the first grouping of a constant has its name, further ones `NAME per COLUMN`."""
    known, out, layout = found.estimates, {}, objective.layout
    for k, learnable in enumerate(layout.distributed):
        made = learnable.distribution
        assert made is not None
        levels = [(layout.effects + e, level) for e, (place, level) in enumerate(layout.levels) if place == k]
        groups = [(k, "trajectory", made.spread, made.fixed)] if made.spread or made.fixed or not levels else []
        groups += [(e, level.column, level.spread, level.fixed) for e, level in levels]
        median = known.at(made.median) if made.median else None
        for number, column, name, fixed in groups:
            spread = known.at(name) if name is not None else None
            key = f"{learnable.name} per {column}" if learnable.name in out else learnable.name
            out[key] = EffectRecord(
                0.0 if median is None else float(known.value[median]),
                fixed if spread is None else float(known.value[spread]),
                None if median is None else _interval(known.low[median], known.high[median]),
                finite(float(found.shrinkage[number])),
                made.kind,
                None if median is None else finite(float(known.sd[median])),
                None if spread is None else _interval(known.low[spread], known.high[spread]),
                per=column,
            )
    return out


def _interval(low: float, high: float) -> tuple[float, float] | None:
    return (float(low), float(high)) if np.isfinite(low) and np.isfinite(high) else None


def _objective(found: PopulationResult, objective: Objective) -> ObjectiveRecord:
    nodes = objective.marginal.nodes
    way = (
        "Laplace's method (FOCEI)" if nodes == 1 else f"adaptive Gauss-Hermite quadrature with {nodes} nodes an effect"
    )
    more = (
        " plus minus twice the log densities of priors and networks' weights"
        if found.point.objective != found.point.minus2ll
        else ""
    )
    if not objective.layout.distributed:  # nothing is integrated
        return ObjectiveRecord(f"likelihood: -2 log likelihood{more}", finite(found.point.objective))
    return ObjectiveRecord(f"marginal likelihood: -2 log likelihood by {way}{more}", finite(found.point.objective))


def _tables(context: Context, found: PopulationResult, objective: Objective, simulated: bool) -> PopulationTables:
    problem, measured = objective.marginal.predictions.problem, objective.marginal.predictions.measured
    row, _ = np.nonzero(problem.seen)
    times = problem.packed.row_time[row]
    arrays = {
        **found.table,
        "owner": measured.owner.astype(np.float64),
        "channel": measured.channel.astype(np.float64),
        "time": times,
        "deviations": found.deviations,
    }
    arrays |= {"check": np.zeros((0, 16)), "npde": np.full(len(times), np.nan)}
    if simulated:
        arrays |= simulated_tables(objective, found.point, times, context.seed)
    return PopulationTables(arrays, tuple(problem.packed.labels))
