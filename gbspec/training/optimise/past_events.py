"""Fits of constants by which rows pass events: solutions jump as these constants change.

Where the time of an event passes that of a row, the sum of squares jumps. A fit that begins on the wrong side of such a
place has no derivative that leads it back, and the lowest fit may be at the place itself, where no derivative vanishes.
So values of such a constant are tried near and far, everything else is fitted with it held, and the lowest fit is
narrowed down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.training.optimise.preconditioned_lbfgs import Rest
from gbspec.training.problem import Parameters

OFFSETS = 0.002 * 2.0 ** np.arange(12)
"""How far the values that are tried are from that of a fit, to either side, on the scale of training."""
TRIED = 4
"""From so many of them, the lowest, everything else is fitted."""
NARROWED = 16
"""Fits by which the lowest value is narrowed down between its neighbours: to 5e-4 of their distance."""
GOLDEN = 0.5 * (5**0.5 - 1)

Fit = Callable[[Array, tuple[int, ...]], Rest]
"""The fit from a vector with entries of it held; its objective is infinite where there is none."""


def passing(model: Model, parameters: Parameters) -> list[int]:
    """The entries of shared constants on which it depends when events happen and doses arrive."""
    decide = [part for e in model.events if e.values for part in (e.guard, e.rank) if part is not None]
    timings = [part for e in model.events if e.timing for part in (e.timing.at, e.timing.every, e.timing.until)]
    lags = [dose.lag for dose in model.doses if not dose.infusion]
    values = model.inlined([part for part in (*decide, *timings, *lags) if part is not None])
    symbols = {symbol for value in values for symbol in value.free_symbols}
    shared = [model.learnables[i] for i in parameters.shared]
    return [parameters.n_weights + place for place, one in enumerate(shared) if one.symbol in symbols]


def beyond_jumps(
    fit: Fit, value: Callable[[Array], float], first: Rest, held: int, passes: Sequence[int], enough: float
) -> Rest:
    """The lowest of a fit with the entry `held` and of those with each of the entries `passes` at other values.

    `value` is the objective at a vector; a fit has converged if its objective is not predicted to fall by more than
    `enough`.
    """
    best = first
    for entry in passes:
        if entry != held:
            best = _along(fit, value, best, (held, entry), enough)
    return best


def _along(fit: Fit, value: Callable[[Array], float], first: Rest, held: tuple[int, int], enough: float) -> Rest:
    """The same along one entry, the second one that is held."""
    middle = float(first.theta[held[1]])
    entries = np.concatenate([middle - OFFSETS[::-1], [middle], middle + OFFSETS])
    each = np.array([value(_moved(first, held[1], entry)) for entry in entries])
    tried = [int(i) for i in np.argsort(each)[:TRIED] if np.isfinite(each[i])]
    fits = {i: fit(_moved(first, held[1], entries[i]), held) for i in tried}
    if not fits:
        return first
    lowest = min(fits, key=lambda i: fits[i].objective)
    if first.promised <= enough and not fits[lowest].objective < first.objective - enough:
        return first
    free = fit(fits[lowest].theta, held[:1])
    if free.promised <= enough and free.objective <= fits[lowest].objective:
        return free
    ends = entries[max(lowest - 1, 0)], entries[min(lowest + 1, len(entries) - 1)]
    found = _narrowed(fit, fits[lowest], held, *map(float, ends))
    if found.objective <= first.objective:
        return found
    # no derivative vanishes at a jump: the first one has converged where no other value of the entry is lower
    return replace(first, promised=found.promised) if found.objective - first.objective <= enough else first


def _narrowed(fit: Fit, best: Rest, held: tuple[int, int], low: float, high: float) -> Rest:
    """The lowest fit between two values of the entry (golden section)."""

    def between(of: Rest, share: float) -> Rest:
        return fit(_moved(of, held[1], low + share * (high - low)), held)

    left, right = between(best, 1 - GOLDEN), between(best, GOLDEN)
    for _ in range(NARROWED):
        if left.objective < right.objective:
            high, right = float(right.theta[held[1]]), left
            left = between(right, 1 - GOLDEN)
        else:
            low, left = float(left.theta[held[1]]), right
            right = between(left, GOLDEN)
        best = min(best, left, right, key=lambda one: one.objective)
    return best


def _moved(rest: Rest, entry: int, value: float) -> Array:
    moved = rest.theta.copy()
    moved[entry] = value
    return moved
