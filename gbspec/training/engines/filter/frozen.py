"""A step for stiff equations: mean and covariance with frozen matrices, whose modes decay exactly.

The matrix F of the best linear function of the drift varies within a step h. With those at its start, middle and end,
F0, Fm and F1, the transition of dA/dt = F A is

    A = e^{h F1 / 6} e^{2 h Fm / 3} e^{h F0 / 6},

and the squares of the disturbances at these times have the exact integrals Q of `propagator.py` in each part: modes
that decay within a step have the variance at which they rest. The weights are Simpson's, and what is left of a step's
error is the commutator of F and its slope (a Magnus method: Hochbruck and Ostermann 2010, Acta Numerica 19, 209). The
last part ends with F1, so that states that follow others at once are spread as those at the end; weights that are not
negative keep covariances positive. (With four exponentials of order 4, of which some weights have to be negative, what
follows at once was behind by a sixth of a step: a stiff model needed ten times the steps.)

In each part, what is left of the drift, E f - F (m - m at its start), is a parabola through its values at the three
times (an exponential Rosenbrock method). Moments at the middle and the end are predicted by steps of order 2. The order
is 3 for the mean, and 2 for the covariance; a step is exact for equations that are linear, with what is added to them a
parabola in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.propagator import Matrices, propagators
from gbspec.training.engines.filter.sigma import Rates, Stage, Varied

BEGIN, MIDDLE, END = Fraction(0), Fraction(1, 2), Fraction(1)
HALF, WHOLE = (0.0, 1 / 4), (0.0, 1 / 6, 5 / 6)
"""Where the parts of half a step, and of a step, begin, as shares of the step."""
Moved = tuple[Varied, Varied, Varied]
"""Mean, transition and added covariance."""


def frozen_step(stage: Stage, mean: Varied, cov: Varied, h: Array) -> Moved:
    """Mean, transition and added covariance of steps of the lengths `h` [b]."""
    begin = stage(BEGIN, mean, cov)
    known = [_Known(begin, mean)]

    def reached(until: Fraction, found: Moved) -> _Known:
        return _Known(stage(until, found[0], _added(found[1], cov, found[2])), found[0])

    # Each time is looked at twice: with matrices of earlier times, states that follow others would be behind.
    first = [_Part.of(begin, 1 / 4, h)] * 2
    known.append(reached(MIDDLE, _through(first, HALF, known, mean, h)))
    first[1] = _Part.of(known[1].rates, 1 / 4, h)
    known[1] = reached(MIDDLE, _through(first, HALF, known, mean, h))
    middle = known[1].rates
    parts = [_Part.of(begin, 1 / 6, h), _Part.of(middle, 2 / 3, h), _Part.of(middle, 1 / 6, h)]
    known.append(reached(END, _through(parts, WHOLE, known, mean, h)))
    parts[2] = _Part.of(known[2].rates, 1 / 6, h)
    known[2] = reached(END, _through(parts, WHOLE, known, mean, h))
    parts[2] = _Part.of(known[2].rates, 1 / 6, h)
    return _through(parts, WHOLE, known, mean, h)


@dataclass(frozen=True)
class _Known:
    """Expectations at a time of a step, and the mean there."""

    rates: Rates
    mean: Varied


@dataclass(frozen=True)
class _Part:
    """A part of a step with one matrix F: its transition, the covariance it adds, and the integrals of forcing."""

    f: Varied
    a: Varied
    q: Varied
    integrals: list[Varied]

    @classmethod
    def of(cls, rates: Rates, share: float, h: Array) -> _Part:
        """The part of this share of the step."""
        a, q, *integrals = _propagated(rates.matrix, rates.square, share * h, 3)
        return cls(rates.matrix, a, q, integrals)


def _through(
    parts: Sequence[_Part], begins: Sequence[float], known: Sequence[_Known], start: Varied, h: Array
) -> Moved:
    """What parts lead to, one after the other. What is left of the drift besides the linear function is a parabola
    through what is known of it at the start, the middle and the end; a straight line or constant where less is."""
    m, way, total = start, None, None
    rate = 1 / np.where(h > 0, h, 1.0)
    for part, begin in zip(parts, begins, strict=True):
        values = [each.rates.drift - part.f @ (each.mean - m) for each in known]
        for integral, coefficient in zip(part.integrals, _parabola(values, begin, rate), strict=False):
            m = m + integral @ coefficient
        if way is None or total is None:
            way, total = part.a, part.q
        else:
            way, total = part.a @ way, _added(part.a, total, part.q)
    assert way is not None
    assert total is not None
    return m, way, total


def _parabola(values: Sequence[Varied], begin: float, rate: Array) -> list[Varied]:
    """The coefficients, in the time from the share `begin` of a step on, of the polynomial with these values at the
    start, the middle and the end of a step; `rate` is one over its length."""
    low, *later = values
    if not later:
        return [low]
    if len(later) == 1:
        slope = (later[0] - low).times(2.0)
        return [low + slope.times(begin), slope.times(rate)]
    middle, high = later
    slope, bend = middle.times(4.0) - low.times(3.0) - high, (low + high - middle.times(2.0)).times(2.0)
    first = low + slope.times(begin) + bend.times(begin**2)
    return [first, (slope + bend.times(2 * begin)).times(rate), bend.times(rate**2)]


def _added(a: Varied, cov: Varied, q: Varied) -> Varied:
    """The covariance after a transition."""
    return a @ cov @ a.transposed + q


def _propagated(f: Varied, square: Varied, h: Array, orders: int) -> list[Varied]:
    """`propagators` with the derivatives in all variables: from those in the entries of F and the squares, which are
    fewer."""
    count, n = f.value.shape[:2]
    d, size = square.value * np.eye(n), n * n
    if f.slopes is None or square.slopes is None:
        none = np.zeros((count, n, 0, n))
        return [Varied(each.value) for each in propagators(Matrices(f.value, none), Matrices(d, none), h, orders)]
    row, column = np.divmod(np.arange(size), n)
    in_f, in_d = (np.zeros((n, size + n, n)) for _ in range(2))
    in_f[row, np.arange(size), column] = 1.0
    in_d[np.arange(n), size + np.arange(n), np.arange(n)] = 1.0
    wide, p = (count, n, size + n, n), f.slopes.shape[1]
    entries = Matrices(f.value, np.broadcast_to(in_f, wide)), Matrices(d, np.broadcast_to(in_d, wide))
    by = np.concatenate([f.slopes.reshape(count, p, size), square.slopes.reshape(count, p, n)], axis=2)
    out = []
    for each in propagators(*entries, h, orders):
        slopes = by @ each.slopes.swapaxes(1, 2).reshape(count, size + n, size)
        out.append(Varied(each.value, slopes.reshape(count, p, n, n)))
    return out
