"""Few residuals that are far from all others: errors of measurement, or rows that the model does not follow.

Errors of measurement are independent: a wrong value stands alone. Residuals that are large in successive rows, to the
same side, are what the model lacks, and to leave such rows out would make intervals narrow without making them right.
Where a channel's own expression contains a held input, a large residual in the rows in which that input changes says
that the measurement was made before the change, and the input written after it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from scipy.stats import hypergeom

from gbspec.arrays import Array, Mask
from gbspec.data import Trajectory, evaluate
from gbspec.ir import Channel, Model, symbol
from gbspec.runs import EXACT, ChannelRecord, autocorrelated
from gbspec.training.problem import Integers, Problem, in_time
from gbspec.training.runs.naming import some_of
from gbspec.training.runs.offered import rounded
from gbspec.training.runs.verdict import not_followed

FAR, FEW, ENOUGH = 6.0, 0.05, 20
"""Residuals beyond `FAR` robust deviations are far from all others, if they are at most `FEW` of at least `ENOUGH`."""

BY_CHANCE = 0.01
"""So many large residuals fall into rows in which an input changes with a smaller probability, if they are anywhere."""

NAMED = 4
"""So many places are named at most."""


@dataclass(frozen=True)
class Place:
    """Successive rows of a trajectory in which residuals are far from all others, to the same side."""

    trajectory: str
    first: float
    last: float
    rows: int


@dataclass(frozen=True)
class Outlying:
    """The residuals of a channel that are far from all others: their `places` in the order of the table, and the held
    input of the channel's own expression that changes in `changed` of these rows, where this is no chance. `several`:
    there are other trajectories too."""

    places: tuple[Place, ...]
    switched: str = ""
    changed: tuple[float, ...] = ()
    several: bool = False
    own_starts: bool = False

    @property
    def rows(self) -> int:
        """How many there are."""
        return sum(place.rows for place in self.places)

    @property
    def together(self) -> bool:
        """Whether most of them have a neighbour among them."""
        return 2 * sum(place.rows for place in self.places if place.rows > 1) > self.rows


def far_from_others(residuals: Array) -> Mask:
    """The residuals [m] beyond `FAR` robust deviations; none where these are many, or do not leave most of the sum of
    squares."""
    none = np.zeros(len(residuals), dtype=np.bool_)
    if len(residuals) < ENOUGH or not np.isfinite(residuals).all():
        return none
    size = np.abs(residuals)
    far = np.asarray(size > FAR * 1.4826 * float(np.median(size)), dtype=np.bool_)
    few = 0 < far.sum() <= FEW * len(residuals)
    return far if few and np.sum(residuals[far] ** 2) > 0.5 * np.sum(residuals**2) else none


def outlying_rows(
    model: Model, problem: Problem, residuals: Array, items: Sequence[Trajectory], own_starts: bool
) -> dict[str, Outlying]:
    """Those `residuals` [R, C] (of `judged_residuals`), by channel, that are far from all others; `items` are the
    trajectories of the problem, by whose labels their inputs are found, `own_starts`: whether some have starts that
    neither the model gives nor the first row."""
    found, packed = {}, problem.packed
    for i, channel in enumerate(model.channels):
        rows = in_time(problem, i)
        own, far = residuals[rows, i], far_from_others(residuals[rows, i])
        if far.any():
            owner, time = packed.row_trajectory[rows], packed.row_time[rows]
            places = _places(own, far, owner, time, packed.labels)
            switched = _switched(model, channel, items, (far, owner, time), packed.labels)
            found[channel.name] = Outlying(places, *switched, len(packed.labels) > 1, own_starts)
    return found


def _places(residuals: Array, far: Mask, owner: Integers, time: Array, labels: Sequence[str]) -> tuple[Place, ...]:
    out: list[Place] = []
    at = np.flatnonzero(far)
    begins = np.ones(len(at), dtype=np.bool_)
    before, now = at[:-1], at[1:]
    same_side = np.sign(residuals[before]) == np.sign(residuals[now])
    begins[1:] = ~((now == before + 1) & (owner[now] == owner[before]) & same_side)
    for part in np.split(at, np.flatnonzero(begins)[1:]):
        out.append(Place(labels[owner[part[0]]], float(time[part[0]]), float(time[part[-1]]), len(part)))
    return tuple(out)


def _switched(
    model: Model,
    channel: Channel,
    items: Sequence[Trajectory],
    measured: tuple[Mask, Integers, Array],
    labels: Sequence[str],
) -> tuple[str, tuple[float, ...]]:
    """The held input of a channel's expression that changes in most rows with large residuals, and when it does."""
    far, owner, time = measured
    by_label, inside = {item.label: item for item in items}, _symbols(model, channel)
    for j, one in enumerate(model.inputs):
        if one.interpolation != "held" or one.infuses or symbol(one.name) not in inside:
            continue
        changes = np.zeros(len(far), dtype=np.bool_)
        for g in np.unique(owner):
            signal, mine = by_label[labels[g]].inputs[j], owner == g
            sides = (evaluate(signal, "held", time[mine], side) for side in ("left", "right"))
            changes[mine] = np.not_equal(*sides)
        both, count = int((far & changes).sum()), int(far.sum())
        if 2 * both > count and hypergeom.sf(both - 1, len(far), int(changes.sum()), count) < BY_CHANCE:
            return one.name, tuple(map(float, time[far & changes]))
    return "", ()


def _symbols(model: Model, channel: Channel) -> set[sympy.Basic]:
    """The symbols of a channel's expression, with those of the intermediate quantities in it."""
    inner = {symbol(one.name): one.value for one in model.intermediates}
    found: set[sympy.Basic] = set()
    waiting = list(channel.value.free_symbols)
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.add(one)
            waiting += inner[one].free_symbols if one in inner else ()
    return found


def said_of_outlying(
    channels: Mapping[str, ChannelRecord], found: Mapping[str, Outlying], model: Model | None, rmse: Mapping[str, float]
) -> list[str]:
    """A warning for each channel with few residuals that are far from all others: where they are, and what to do."""
    out = []
    for channel in model.channels if model is not None and not model.marginal else ():
        followed, one = channels.get(channel.name), found.get(channel.name)
        if model is None or followed is None or one is None or followed.r2 is None or not_followed(followed):
            continue
        if 1 - followed.r2 <= EXACT:
            continue
        count = one.rows
        are = "is" if count == 1 else "are"
        where = _where(one.places, model, one.several)
        begin = f"{count} of {followed.values} residuals of `{channel.name}` {are} far from all others ({where})"
        if one.switched:
            out.append(begin + _at_switches(one, channel.name, count))
        elif one.together or channel.name in autocorrelated(channels):
            together = ", in rows that follow one another" if one.together else ""
            out.append(begin + together + _NOT_FOLLOWED + (_FAST if not model.networks else ""))
        else:
            out.append(begin + _alone(channel, one, model, rmse, bool(followed.censored)))
    return out


def _where(places: Sequence[Place], model: Model, several: bool) -> str:
    """The times of the first places; with their trajectories, if there are several."""
    spelled = []
    for place in places:
        span = f"{place.first:.6g}" if place.rows == 1 else f"{place.first:.6g} to {place.last:.6g}"
        spelled.append(f"{span} of trajectory `{place.trajectory}`" if several else span)
    return f"{model.time.name} = {some_of(spelled, NAMED)}"


def _at_switches(one: Outlying, channel: str, count: int) -> str:
    changed = len(one.changed)
    which = "in this row" if count == 1 else "in these rows"
    if changed < count:
        more = ", …" if changed > NAMED else ""
        which = f"in {changed} of them ({', '.join(f'{time:.6g}' for time in one.changed[:NAMED])}{more})"
    return (
        f": the input `{one.switched}`, which the expression of `{channel}` contains, changes {which}, and the "
        f"expression has its new value there. Where `{channel}` was measured before the change, write two rows: the "
        f"measurement in a row just before the change, and the new value of `{one.switched}` in a row of its own (see "
        "`held` inputs in the page on data); where it is not known, leave the cells of these rows empty"
    )


_NOT_FOLLOWED = (
    ": the model does not follow these rows. Look at them in `gbspec plot RUN fit` and `residuals`: something may act "
    "there that the model does not have, or an input is wrong. To leave them out would make intervals narrower, not "
    "the model better"
)
_FAST = (
    ". Around a fast change that is predicted too early or too late the fit may be in another minimum, or its steps "
    "are too long: `--effort high`, narrower bounds, `--solver ros34pw2`"
)


def _student(channel: Channel, model: Model, rmse: float) -> str:
    """The noise with heavy tails that may be written too; empty where the language does not take it, or where noise is
    in proportion to values."""
    own = any(k.per_trajectory and k.distribution is None for k in model.learnables)
    in_proportion = channel.noise is not None and channel.noise.kind == "lognormal"
    if model.events or model.delays or model.diffusions or own or in_proportion:
        return ""
    name = channel.name
    return f", or write `observe {name} … noise student(s_{name}, 4)` with `learn s_{name} = {rounded(0.3 * rmse)} > 0`"


def _alone(channel: Channel, one: Outlying, model: Model, rmse: Mapping[str, float], censored: bool) -> str:
    count, fitted = one.rows, not (censored or one.own_starts)  # a likelihood takes neither limits nor such starts
    student = _student(channel, model, rmse.get(channel.name, math.nan)) if fitted else ""
    if count == 1:
        error, row, cells = "it is a wrong value (an outlier)", "it", "this cell"
        moves = "a wrong value moves the fit and widens its intervals"
    else:
        error, row, cells = "they are wrong values (outliers)", "them", "these cells"
        moves = "wrong values move the fit and widen its intervals"
    return (
        f": {error}, or the model does not follow the row{'' if count == 1 else 's'}. Check {row} first: {moves}; "
        f"then leave {cells} empty{student}" + (_FAST if not model.networks else "")
    )
