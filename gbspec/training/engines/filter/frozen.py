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
from fractions import Fraction

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.propagator import Matrices, propagators
from gbspec.training.engines.filter.sigma import Rates, Stage, Varied

BEGIN, MIDDLE, END = Fraction(0), Fraction(1, 2), Fraction(1)
PARTS = ((0.0, 1 / 6), (1 / 6, 2 / 3), (5 / 6, 1 / 6))
"""Where the parts of a step begin and how long they are, as shares of it."""
Moved = tuple[Varied, Varied, Varied]
"""Mean, transition and added covariance."""


def frozen_step(stage: Stage, mean: Varied, cov: Varied, h: Array) -> Moved:
    """Mean, transition and added covariance of steps of the lengths `h` [b]."""
    rates, means = _stages(stage, mean, cov, h)
    m, a, q = _part(0, rates, means, mean, h)
    for number in (1, 2):
        m, later, added = _part(number, rates, means, m, h)
        a, q = later @ a, _added(later, q, added)
    return m, a, q


def _stages(stage: Stage, mean: Varied, cov: Varied, h: Array) -> tuple[list[Rates], list[Varied]]:
    """Expectations at the start, the middle and the end of steps, and the means there."""
    half = 0.5 * h
    rate = 1 / np.where(half > 0, half, 1.0)
    begin = stage(BEGIN, mean, cov)
    m, a, q = _moved(begin.matrix, begin.square, [begin.drift], mean, half)
    guess = stage(MIDDLE, m, _added(a, cov, q))
    f, square = (begin.matrix + guess.matrix).times(0.5), (begin.square + guess.square).times(0.5)
    slope = (_left(guess, f, m - mean) - begin.drift).times(rate)
    m_middle, a, q = _moved(f, square, [begin.drift, slope], mean, half)
    middle = stage(MIDDLE, m_middle, _added(a, cov, q))
    slope = (_left(middle, middle.matrix, m_middle - mean) - begin.drift).times(rate)
    m_end, a, q = _moved(middle.matrix, middle.square, [begin.drift, slope], mean, h)
    return [begin, middle, stage(END, m_end, _added(a, cov, q))], [mean, m_middle, m_end]


def _part(number: int, rates: Sequence[Rates], means: Sequence[Varied], start: Varied, h: Array) -> Moved:
    """A part of a step, from the mean `start`, with the matrix of its own time."""
    (begin, length), here = PARTS[number], rates[number]
    low, middle, high = (_left(each, here.matrix, m - start) for each, m in zip(rates, means, strict=True))
    # The parabola through the three, in shares of the step, and then in time from the start of the part.
    slope, bend = middle.times(4.0) - low.times(3.0) - high, (low + high - middle.times(2.0)).times(2.0)
    rate = 1 / np.where(h > 0, h, 1.0)
    first = low + slope.times(begin) + bend.times(begin**2)
    forcing = [first, (slope + bend.times(2 * begin)).times(rate), bend.times(rate**2)]
    return _moved(here.matrix, here.square, forcing, start, length * h)


def _left(rates: Rates, f: Varied, moved: Varied) -> Varied:
    """What is left of the drift besides the linear function of the movement."""
    return rates.drift - f @ moved


def _added(a: Varied, cov: Varied, q: Varied) -> Varied:
    """The covariance after a transition."""
    return a @ cov @ a.transposed + q


def _moved(f: Varied, square: Varied, forcing: Sequence[Varied], start: Varied, h: Array) -> Moved:
    """What these matrices lead to; `forcing` are the coefficients of a polynomial in the time, for the movement from
    the start."""
    a, q, *integrals = _propagated(f, square, h, len(forcing))
    for integral, coefficient in zip(integrals, forcing, strict=True):
        start = start + integral @ coefficient
    return start, a, q


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
