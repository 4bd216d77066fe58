"""The learned constants of a run: values, standard deviations, intervals within the bounds, correlations."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from itertools import combinations
from types import MappingProxyType

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.files import finite
from gbspec.ir import Learnable, Model
from gbspec.runs import NORMAL_90, ConstantRecord, OwnRecord, quantile
from gbspec.training.problem import CLOSE, NARROW, Bijection, Bijections
from gbspec.training.runs.beside_naive import lost_ahead
from gbspec.training.runs.limiting_noise import said_of_limits
from gbspec.training.runs.naming import labelled
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.verdict import named_inseparable, not_followed

NEARBY, AWAY = 0.1, 10
"""Without a standard deviation a constant is near a bound that it differs from by this part, where bounds are orders
of magnitude apart (else at `CLOSE`: on a linear scale small values are nothing special), and to which it has come from
a start so many times as far off."""
TOGETHER = 0.95
"""A warning is given for correlations beyond this."""
NEGLIGIBLE = 0.3
"""Constants with smaller components are omitted from the description of a direction."""
COVERED = 0.9
"""An interval that covers this fraction of the bounds says no more than they do."""
SPELLED_OUT = 2
"""So many pairs and groups of correlated constants have a warning each; more of them share one."""
EXACT = 1e-20
"""Up to this mean loss, the data are fitted to rounding."""


def constant_record(
    learnable: Learnable, results: list[MemberResult], own: Mapping[str, OwnRecord] | None
) -> ConstantRecord:
    """Mean over members, standard deviation (within and between members), and a 90 % interval."""
    values = np.array([r.constants[learnable.name] for r in results])
    within = np.array([r.sd[learnable.name] for r in results])
    center, sd, interval = _estimate(learnable, values, within, half_width(results))
    by_likelihood = [r.intervals[learnable.name] for r in results if learnable.name in r.intervals]
    if by_likelihood and (interval is not None or len(by_likelihood) == len(results)):
        # Those of all members say enough; where some have none, at least what either says. A size at next to none has
        # no deviation.
        some = interval is not None and len(by_likelihood) < len(results)
        lows, highs = zip(*by_likelihood, *([interval] if some and interval else []), strict=True)
        interval = min(lows), max(highs)
    return ConstantRecord(center, sd, interval, learnable.start, tuple(map(float, values)), own)


def _estimate(
    learnable: Learnable, values: Array, within: Array, half: float
) -> tuple[float, float | None, tuple[float, float] | None]:
    """The mean of the members' values, its standard deviation from those `within` members, and a 90 % interval within
    the bounds, of which `half` the width in standard deviations is given."""
    between = values.var(ddof=1) if len(values) > 1 else 0.0
    sd = math.sqrt(float(np.mean(within**2)) + float(between)) if np.isfinite(within).all() else float("nan")
    center = float(values.mean())
    return center, finite(sd), inside_bounds(learnable, center, sd, half) if math.isfinite(sd) else None


def own_records(model: Model, results: list[MemberResult]) -> dict[str, dict[str, OwnRecord]]:
    """The constants per trajectory by name, and by the labels of the trajectories that all members were fitted to."""
    common = [label for label in results[0].labels if all(label in r.labels for r in results)]
    out: dict[str, dict[str, OwnRecord]] = {}
    for j, learnable in enumerate(k.individual for k in model.learnables if k.per_trajectory):
        records = out[learnable.name] = {}
        for label in common:
            rows = [(r, r.labels.index(label)) for r in results]
            values, within = (np.array([getattr(r, name)[row, j] for r, row in rows]) for name in ("own", "own_sd"))
            center, sd, interval = _estimate(learnable, values, within, half_width(results))
            records[label] = OwnRecord(center, sd, interval)
    return out


def half_width(results: Iterable[MemberResult]) -> float:
    """Half the width of 90 % intervals in standard deviations: by the member with the fewest degrees of freedom."""
    return quantile(min((r.freedom for r in results if r.freedom is not None), default=None))


def inside_bounds(
    learnable: Learnable, center: float, sd: float, half: float = NORMAL_90
) -> tuple[float, float] | None:
    """The interval of a constant, `half` its width in standard deviations: symmetrical on the scale on which it is
    trained, whose values all lie within the bounds; None for a constant at its bound, where this scale ends, and where
    an end is too large for a number."""
    scale = Bijections.of((learnable,))
    place = scale.from_natural(np.array([center]))
    slope = abs(float(scale.derivative(place)[0]))
    if not slope > 0:
        return None
    reach = half * sd / slope
    ends = [float(scale.to_natural(torch.from_numpy(place + move))[0]) for move in (-reach, reach)]
    if not np.isfinite(ends).all():
        return None
    told = [Bijection.of(learnable).end(end, center) for end in ends]
    return min(*told, center), max(*told, center)


def correlations_of(names: list[str], results: list[MemberResult]) -> dict[str, dict[str, float]]:
    """Correlations of the shared constants by their names, the mean over members; empty where one is not known."""
    tables = [r.correlations for r in results]
    if len(names) < 2 or any(t.shape != (len(names), len(names)) or not np.isfinite(t).all() for t in tables):
        return {}
    mean = np.mean(tables, axis=0)
    return {a: {b: float(mean[i, j]) for j, b in enumerate(names)} for i, a in enumerate(names)}


def moving_together(
    correlations: Mapping[str, Mapping[str, float]], certain: Collection[str] = frozenset()
) -> list[str]:
    """Warnings about strongly correlated constants: pairs, then groups that contain no such pair; one of all of them,
    where there are more than `SPELLED_OUT`.

    A group consists of the constants in an eigenvector of the correlation matrix whose eigenvalue is below
    1 - TOGETHER, the value of a pair at the limit: this combination of estimates is known far better than they are,
    so that they move together. Nothing is said of those that are all `certain` nevertheless.
    """
    names = list(correlations)
    table = np.array([[correlations[a][b] for b in names] for a in names]).reshape(len(names), len(names))
    pairs = [(i, j) for i, j in combinations(range(len(names)), 2) if abs(table[i, j]) > TOGETHER]
    told = [
        (
            f"`{names[i]}` and `{names[j]}` ({table[i, j]:.3f})",
            f"`{names[i]}` and `{names[j]}` are strongly correlated (correlation {table[i, j]:.3f}): "
            "the data determine a combination of them better than either",
        )
        for i, j in pairs
        if not {names[i], names[j]} <= set(certain)
    ]
    values, vectors = np.linalg.eigh(table)
    for value, direction in zip(values, vectors.T, strict=True):
        group = [i for i in range(len(names)) if abs(direction[i]) > NEGLIGIBLE]
        known = {names[i] for i in group} <= set(certain)
        if value < 1 - TOGETHER and not known and not any(i in group and j in group for i, j in pairs):
            listed = " ".join(f"{direction[i]:+.2f} `{names[i]}`" for i in group)
            together = (" and " if len(group) == 2 else ", ").join(f"`{names[i]}`" for i in group)
            said = (
                f"{together} are strongly correlated: the data determine the combination {listed} (in standard "
                "deviations) better than each of them; give one of them its value, or a prior, if it is known"
            )
            told.append((together, said))
    if len(told) <= SPELLED_OUT:
        return [text for _, text in told]
    listed = "; ".join(brief for brief, _ in told)
    return [
        f"strongly correlated constants: {listed}. The data determine a combination of each of these pairs and groups "
        "better than the constants in it; give some of them values, or priors, if they are known"
    ]


def at_bounds(
    model: Model, constants: Mapping[str, float], sd: Mapping[str, float] | None = None
) -> list[tuple[str, float]]:
    """Learnable constants that ended at a bound, and the bound, by their standard deviations `sd` where these are
    known."""
    found = (
        (k.name, Bijection.of(k).ended_at(constants[k.name], (sd or {}).get(k.name, math.nan)))
        for k in model.learnables
        if k.name in constants
    )
    return [(name, bound) for name, bound in found if bound is not None]


def undetermined(
    model: Model,
    constants: Mapping[str, ConstantRecord],
    at_limits: Mapping[str, str] = MappingProxyType({}),
    untested: AbstractSet[str] = frozenset(),
) -> list[str]:
    """A warning of the constants whose intervals cover their bounds: value and standard deviation, which holds near the
    value alone, may seem to say more. `at_limits`: what is said of shapes of noises at upper bounds; of the `untested`
    ones only the curvature says that they are open."""
    at_bound, open_ones = [], []
    for learnable in model.learnables:
        record, bounds = constants.get(learnable.name), learnable.range
        if record is None or record.interval is None or not covers(learnable, record.interval):
            continue
        near = min((bounds.low, bounds.high), key=lambda bound: abs(record.value - bound))
        narrow = Bijection.of(learnable).share(record.value, record.sd) < NARROW
        if narrow and abs(record.value - near) < 3 * (record.sd or 0.0):
            otherwise = (
                "widen the bounds if values beyond are plausible, else the model or another constant is not what it "
                "should be"
            )
            at_bound.append(
                f"`{learnable.name}` lies at its bound {near:g}, within its standard deviation of {record.sd:.2g}; its "
                "interval, which cannot leave the bounds, says nothing there: "
                f"{at_limits.get(learnable.name, otherwise)}"
            )
        else:
            open_ones.append((learnable, record.interval))
    known = [one for one in open_ones if one[0].name not in untested]
    left = [_not_tested(model, *one) for one in open_ones if one[0].name in untested]
    return [*_not_determined(known), *left, *at_bound]


def covers(learnable: Learnable, interval: tuple[float, float] | None) -> bool:
    """Whether an interval says no more than the bounds of a constant."""
    bounds = learnable.range
    if interval is None or not bounds.bounded or bounds.low >= bounds.high:
        return False
    ends = np.array([*interval, bounds.low, bounds.high])
    low, high, least, most = np.log(np.abs(ends)) if bounds.logarithmic else ends
    return bool(abs(high - low) >= COVERED * abs(most - least))


def _not_determined(found: Sequence[tuple[Learnable, tuple[float, float]]]) -> list[str]:
    """One warning of all constants whose intervals cover their bounds."""
    narrower = "narrower " * all(k.prior is not None for k, _ in found)
    if len(found) > 1:
        names = [f"`{k.name}`" for k, _ in found]
        return [
            f"{', '.join(names[:-1])} and {names[-1]} are not determined by these data: their 90 % intervals cover "
            f"their bounds. Give them values (`const`) or {narrower}priors if something is known of them, or measure "
            "what they act on"
        ]
    return [
        f"`{k.name}` is not determined by these data: its 90 % interval, {low:.4g} to {high:.4g}, covers its bounds. "
        f"Give it a value (`const`) or a {narrower}prior if something is known of it, or measure what it acts on"
        for k, (low, high) in found
    ]


def _not_tested(model: Model, learnable: Learnable, interval: tuple[float, float]) -> str:
    """The warning of a constant that the curvature alone leaves open."""
    profile = "" if model.diffusions else ": `gbspec profile` tells"
    return (
        f"the 90 % interval of `{learnable.name}`, {interval[0]:.4g} to {interval[1]:.4g}, covers its bounds: the "
        "curvature at the estimate, from which it is computed, leaves it open; whether the data do is not known"
        f"{profile}. Narrower bounds, a prior or a value (`const`) help if something is known of it"
    )


def undetermined_own(
    model: Model, constants: Mapping[str, ConstantRecord], tested: AbstractSet[tuple[str, str]]
) -> list[str]:
    """Warnings of constants of single trajectories, without a distribution, whose intervals cover their bounds: of
    those that were `tested` and found open, by name and label, and of the others."""
    open_ones, untested = dict[str, list[str]](), dict[str, list[str]]()
    for k in model.learnables:
        record = constants.get(k.name) if k.per_trajectory and k.distribution is None else None
        for label, one in ((record.per_trajectory or {}) if record is not None else {}).items():
            if covers(k.individual, one.interval):
                found = open_ones if (k.name, label) in tested else untested
                found.setdefault(k.name, []).append(label)
    return [_of_open_own(model, found, found is open_ones) for found in (open_ones, untested) if found]


def _of_open_own(model: Model, found: Mapping[str, Sequence[str]], tested: bool) -> str:
    single = sum(map(len, found.values())) == 1
    whose, their, values = ("interval", "its", "value") if single else ("intervals", "their", "values")
    known = f"these data do not determine {their} {values}"
    if not tested:
        known = (
            f"the curvature at the estimate, from which intervals are computed, leaves {'it' if single else 'them'} "
            "open; whether the data do was not tested"
        )
    narrower = "narrower " * all(k.prior is not None for k in model.learnables if k.name in found)
    return (
        f"the 90 % {whose} of {listed_own(found)} {'covers' if single else 'cover'} {their} bounds: {known}. "
        f"A {narrower}prior, a value (`const`) or one value for all trajectories helps, or measurements of what "
        f"{'it acts' if single else 'they act'} on"
    )


def listed_own(found: Mapping[str, Sequence[str]]) -> str:
    """Constants with the labels of the trajectories in which something holds."""
    each = [f"`{name}` of {labelled(labels)}" for name, labels in found.items()]
    return "; ".join(each)


def said_of_constants(
    model: Model,
    constants: Mapping[str, ConstantRecord],
    ended: Sequence[tuple[int, str, float]],
    results: Mapping[int, MemberResult],
) -> list[str]:
    """What is said of constants that the data do not determine, or that `ended` at bounds; members that follow no data
    say nothing of them."""
    astray = lost(results)
    at_limits = said_of_limits(model, ended, results)
    meant = [one for one in ended if one[1] not in results[one[0]].vanished]
    known = {name: text for (_, name), text in at_limits.items()}
    followed = len(astray) < len(results)
    tested = {one for result in results.values() for one in result.open_own}
    untested = {name for result in results.values() for name in result.untested}
    open_ones = undetermined(model, constants, known, untested), undetermined_own(model, constants, tested)
    unclear = [text for said in open_ones for text in said] if followed else []
    beside = {
        (member, name): results[member].constants[name]
        for member, name, bound in meant
        if (name, bound) not in at_bounds(model, results[member].constants)
    }
    alone = [] if model.marginal else unsettled(constants, ended, results, model)
    near = [] if model.marginal or model.diffusions else near_bounds(model, ended, results)
    return [*unclear, *ended_at_bounds(meant, astray, beside, at_limits), *near, *alone]


def near_bounds(
    model: Model, ended: Sequence[tuple[int, str, float]], results: Mapping[int, MemberResult]
) -> list[str]:
    """A warning for each shared constant near a bound in a fit without standard deviations, which did not come to rest:
    how near others may be depends on these alone (`Bijection.ended_at`)."""
    told, out = {(member, name) for member, name, _ in ended}, []
    for member, result in sorted(results.items()):
        if not result.finished or result.misjudged or np.isfinite(list(result.sd.values())).any():
            continue
        for k in model.learnables:
            one, value = Bijection.of(k), result.constants.get(k.name)
            if k.per_trajectory or value is None or not one.two_sided or (member, k.name) in told:
                continue
            out += [
                f"member {member}: `{k.name}` ended at {value:.3g}, near its bound {bound:g}, in a fit that has not "
                "come to rest: it may have been on its way there. Widen the bounds if values beyond it are plausible"
                for bound in (k.range.low, k.range.high)
                if _beside(one, value, bound) and one.distance(k.start, bound) > AWAY * one.distance(value, bound)
            ]
    return out


def unsettled(
    constants: Mapping[str, ConstantRecord],
    ended: Sequence[tuple[int, str, float]],
    results: Mapping[int, MemberResult],
    model: Model | None = None,
) -> list[str]:
    """Warnings of constants that alone of all have no interval, and for no reason that is told elsewhere: shared ones,
    and those of single trajectories."""
    own = _unsettled_own(constants, {n for one in results.values() for n in one.misjudged_own | one.bounded_own})
    shared = {name: record for name, record in constants.items() if record.per_trajectory is None}
    told = " ".join(text for one in results.values() for text in (*one.tied, *one.notes) if "no interval" in text)
    at_ends = {name for _, name, _ in ended}
    unknown = [n for n, one in shared.items() if one.sd is None and one.interval is None]
    found = [n for n in unknown if n not in at_ends and f"`{n}`" not in told]
    if all(record.sd is None for record in shared.values()):
        return own
    unseen = named_inseparable(model) if found and model is not None else set()  # more steps would not help
    found = [name for name in found if name not in unseen]
    if not found:
        return own
    names, verb = ", ".join(f"`{name}`" for name in found), "has" if len(found) == 1 else "have"
    return [
        f"{names} {verb} no interval: the fit has not come to rest there (a next step would be longer than the "
        "standard deviation), as where the data hardly show a constant, or a function takes its place. `--effort high` "
        "goes on; a prior, a contract or a value (`const`) says what the data do not",
        *own,
    ]


def _beside(one: Bijection, value: float, bound: float) -> bool:
    return abs(value - bound) < NEARBY * abs(bound) if one.logarithmic else one.distance(value, bound) < CLOSE


def _unsettled_own(constants: Mapping[str, ConstantRecord], explained: AbstractSet[tuple[str, str]]) -> list[str]:
    """A warning for each constant per trajectory that has an interval in some trajectories alone; of those that have
    none for a reason that is `explained` elsewhere, by name and label, nothing is said."""
    out = []
    for name, record in constants.items():
        each = record.per_trajectory or {}
        without = [label for label, one in each.items() if one.sd is None and (name, label) not in explained]
        if without and len(without) < len(each):
            out.append(
                f"`{name}` has no interval in {len(without)} of {len(each)} trajectories ({labelled(without)}): the "
                "fit has not come to rest there (a next step would be longer than the standard deviation), as where a "
                "value lies at a bound or the rows hardly show it. A prior helps, or one value for all trajectories"
            )
    return out


def ended_at_bounds(
    ended: Iterable[tuple[int, str, float]],
    astray: AbstractSet[int],
    beside: Mapping[tuple[int, str], float],
    at_limits: Mapping[tuple[int, str], str],
) -> list[str]:
    """A warning for each constant of a member that ended at a bound; `beside`: the values of those that are only closer
    to it than their standard deviations; `at_limits`: what is said of shapes of noises."""

    def meaning(member: int, name: str, bound: float) -> str:
        if member in astray:
            return "since the fit does not follow the data, that says nothing of where the constant lies"
        if (member, name) in at_limits:
            return at_limits[member, name]
        return "the data do not need it" if not bound else "widen the bounds if values beyond it are plausible"

    def where(member: int, name: str, bound: float) -> str:
        if (member, name) not in beside:
            return f"its bound {bound:g}"
        return (
            f"{beside[member, name]:.5g}, beside its bound {bound:g} (nearer than a third of its standard deviation): "
            "no standard deviation or interval holds there"
        )

    return [
        f"member {member}: `{name}` ended at {where(member, name, bound)}; {meaning(member, name, bound)}"
        for member, name, bound in ended
    ]


def lost(results: Mapping[int, MemberResult]) -> frozenset[int]:
    """The members of which whole solutions follow no channel better than the best naive predictor, or predictions one
    row ahead are far worse than it for all of them."""
    return frozenset(
        member
        for member, result in results.items()
        if result.channels
        and all((not_followed if result.likelihood is None else lost_ahead)(one) for one in result.channels.values())
    )
