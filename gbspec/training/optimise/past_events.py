"""Fits of constants by which rows pass events: solutions jump as these constants change.

Where the time of an event passes that of a row, the sum of squares jumps. A fit that begins on the wrong side of such a
place has no derivative that leads it back, and the lowest fit may be at the place itself, where no derivative vanishes.
So values of such a constant are tried near and far, everything else is fitted with it held, and the lowest fit is
narrowed down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Learnable, Model
from gbspec.training.optimise.preconditioned_lbfgs import Rest
from gbspec.training.problem import Bijections, Parameters

OFFSETS = 0.002 * 2.0 ** np.arange(12)
"""How far the values that are tried are from that of a fit, to either side, on the scale of training."""
BETWEEN = 16
"""So many values between its bounds are tried too: on that scale a value at a bound is far from all others."""
TRIED = 4
"""From so many of them, the lowest, everything else is fitted."""
NARROWED = 16
"""Fits by which the lowest value is narrowed down between its neighbours: to 5e-4 of their distance."""
ROUNDS = 3
"""How often all such constants are gone through, as long as the fit gets lower."""
MOST = 12
"""With more such constants (each trajectory has those of its own) nothing is tried: it takes too long."""
GOLDEN = 0.5 * (5**0.5 - 1)

Fit = Callable[[Array, tuple[int, ...]], Rest]
"""The fit from a vector with entries of it held; its objective is infinite where there is none."""


@dataclass(frozen=True)
class Passing:
    """The entries of the vector on which it depends when events happen and doses arrive, and for each the values
    between its bounds that are tried."""

    entries: tuple[int, ...] = ()
    between: tuple[Array, ...] = ()

    @classmethod
    def of(cls, model: Model, parameters: Parameters) -> Passing:
        """Those of shared constants, and of those of single trajectories; none where they are too many."""
        decide = [part for e in model.events if e.values for part in (e.guard, e.rank) if part is not None]
        timings = [part for e in model.events if e.timing for part in (e.timing.at, e.timing.every, e.timing.until)]
        lags = [dose.lag for dose in model.doses if not dose.infusion]
        values = model.inlined([part for part in (*decide, *timings, *lags) if part is not None])
        symbols = {symbol for value in values for symbol in value.free_symbols}
        found = [(parameters.n_weights + place, i) for place, i in enumerate(parameters.shared)]
        first = range(parameters.n_shared, parameters.size, max(parameters.n_local, 1))
        found += [(begin + place, i) for begin in first for place, i in enumerate(parameters.own)]
        chosen = [(entry, model.learnables[i]) for entry, i in found if model.learnables[i].symbol in symbols]
        if len(chosen) > MOST:
            return cls()
        return cls(tuple(entry for entry, _ in chosen), tuple(_between(one) for _, one in chosen))


def _between(learnable: Learnable) -> Array:
    """Values on the scale of training, at equal distances between bounds."""
    low, high = learnable.range.low, learnable.range.high
    if not learnable.range.bounded:
        return np.zeros(0)
    shares = (np.arange(BETWEEN) + 0.5) / BETWEEN
    return Bijections.of((learnable,) * BETWEEN).from_natural(low + shares * (high - low))


def beyond_jumps(
    fit: Fit,
    value: Callable[[Array], float],
    first: Rest,
    held: int,
    passing: Passing,
    enough: float,
    low: float = -math.inf,
) -> Rest:
    """The lowest of a fit with the entry `held` and of those with the entries `passing` at other values.

    `value` is the objective at a vector; a fit has converged if its objective is not predicted to fall by more than
    `enough`. Below `low` no lower one is needed.
    """
    best, places = first, [i for i, entry in enumerate(passing.entries) if entry != held]
    everything = (held, *(passing.entries[i] for i in places))
    for _ in range(ROUNDS):
        before = best
        for place in places:
            if best.objective <= low:
                return best
            search = _Search(fit, value, passing.entries[place], everything, enough, low)
            best = search.along(best, passing.between[place])
        if not best.objective < before.objective - enough:
            break
    return best


@dataclass(frozen=True)
class _Search:
    """The search along one entry, with all entries by which rows pass events `held` behind the first one."""

    fit: Fit
    value: Callable[[Array], float]
    entry: int
    held: tuple[int, ...]
    enough: float
    low: float

    def along(self, first: Rest, between: Array) -> Rest:
        """The lowest of a fit and of those with other values of the entry."""
        middle = float(first.theta[self.entry])
        entries = np.unique(np.concatenate([middle - OFFSETS, [middle], middle + OFFSETS, between]))
        each = np.array([self.value(_moved(first, self.entry, entry)) for entry in entries])
        tried = [int(i) for i in np.argsort(each)[:TRIED] if np.isfinite(each[i])]
        fits = {i: self.fit(_moved(first, self.entry, entries[i]), self.held) for i in tried}
        if not fits:
            return first
        lowest = min(fits, key=lambda i: fits[i].objective)
        if fits[lowest].objective <= self.low:
            return fits[lowest]
        if first.promised <= self.enough and not fits[lowest].objective < first.objective - self.enough:
            return first
        free = self.fit(fits[lowest].theta, self.held[:1])
        if free.promised <= self.enough and free.objective <= min(fits[lowest].objective, first.objective):
            return free
        ends = entries[max(lowest - 1, 0)], entries[min(lowest + 1, len(entries) - 1)]
        found = self._narrowed(fits[lowest], *map(float, ends))
        if found.objective <= first.objective:
            return found
        # no derivative vanishes at a jump: the first one has converged where no other value of the entry is lower
        return replace(first, promised=found.promised) if found.objective - first.objective <= self.enough else first

    def _narrowed(self, best: Rest, low: float, high: float) -> Rest:
        """The lowest fit between two values of the entry (golden section)."""

        def between(of: Rest, share: float) -> Rest:
            return self.fit(_moved(of, self.entry, low + share * (high - low)), self.held)

        left, right = between(best, 1 - GOLDEN), between(best, GOLDEN)
        for _ in range(NARROWED):
            if best.objective <= self.low:
                break
            if left.objective < right.objective:
                high, right = float(right.theta[self.entry]), left
                left = between(right, 1 - GOLDEN)
            else:
                low, left = float(left.theta[self.entry]), right
                right = between(left, GOLDEN)
            best = min(best, left, right, key=lambda one: one.objective)
        return best


def _moved(rest: Rest, entry: int, value: float) -> Array:
    moved = rest.theta.copy()
    moved[entry] = value
    return moved
