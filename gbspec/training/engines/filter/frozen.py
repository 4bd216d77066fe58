"""A step for stiff equations: mean and covariance with frozen matrices, whose modes decay exactly.

The matrix F of the best linear function of the drift varies within a step h. With those at its start, middle and end,
F0, Fm and F1, the transition of dA/dt = F A is

    A = e^{h F" / 2} e^{h F' / 2},    F' = F0/2 + 2 Fm/3 - F1/6,    F" = -F0/6 + 2 Fm/3 + F1/2,

of order 4 (commutator-free: Blanes and Moan 2006, Appl. Numer. Math. 56, 1519; Alvermann and Fehske 2011, J. Comput.
Phys. 230, 5930), and the same combinations of the squares of the disturbances have the exact integrals Q of
`propagator.py` in each half: modes that decay within a step have the variance at which they rest. What is left of the
drift, E f - F (m - m0), is a parabola through its values at the three times (an exponential Rosenbrock method:
Hochbruck and Ostermann 2010, Acta Numerica 19, 209). Moments at the middle and the end are predicted by steps of order
2. The order is 3; for equations that are linear, with what is added to them a parabola in time, a step is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.propagator import Matrices, propagators
from gbspec.training.engines.filter.sigma import Rates, Stage, Varied

BEGIN, MIDDLE, END = Fraction(0), Fraction(1, 2), Fraction(1)
HALVES = ((1 / 2, 2 / 3, -1 / 6), (-1 / 6, 2 / 3, 1 / 2))
"""The weights of start, middle and end in each half."""
Moments = tuple[Varied, Varied]


def frozen_step(stage: Stage, mean: Varied, cov: Varied, h: Array) -> tuple[Varied, Varied, Varied]:
    """Mean, transition and added covariance of steps of the lengths `h` [b]."""
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
    end = stage(END, m_end, _added(a, cov, q))
    three, means = (begin, middle, end), (mean, m_middle, m_end)
    m, a, q = _half(0, three, means, mean, rate, half)
    m, a_later, q_later = _half(1, three, means, m, rate, half)
    return m, a_later @ a, _added(a_later, q, q_later)


def _half(
    number: int, stages: Sequence[Rates], means: Sequence[Varied], start: Varied, rate: Array, length: Array
) -> tuple[Varied, Varied, Varied]:
    """The first (0) or the second (1) half of a step, from the mean `start`; `rate` is one over its length."""
    f = _combined([each.matrix for each in stages], number)
    square = _positive(_combined([each.square for each in stages], number))
    low, middle, high = (_left(each, f, m - start) for each, m in zip(stages, means, strict=True))
    bend = (low + high - middle.times(2.0)).times(0.5 * rate**2)
    if number == 0:
        first, slope = low, middle.times(4.0) - low.times(3.0) - high
    else:
        first, slope = middle, high - low
    return _moved(f, square, [first, slope.times(0.5 * rate), bend], start, length)


def _combined(parts: Sequence[Varied], number: int) -> Varied:
    first, second, third = (part.times(weight) for part, weight in zip(parts, HALVES[number], strict=True))
    return first + second + third


def _positive(square: Varied) -> Varied:
    """Squares that would be negative, since they vary much within a step, are zero."""
    keep = square.value > 0
    return Varied(np.where(keep, square.value, 0.0), None if square.slopes is None else square.slopes * keep[:, None])


def _left(rates: Rates, f: Varied, moved: Varied) -> Varied:
    """What is left of the drift besides the linear function of the movement."""
    return rates.drift - f @ moved


def _added(a: Varied, cov: Varied, q: Varied) -> Varied:
    return a @ cov @ a.transposed + q


def _moved(
    f: Varied, square: Varied, forcing: Sequence[Varied], start: Varied, h: Array
) -> tuple[Varied, Varied, Varied]:
    """Mean, transition and added covariance with these matrices; `forcing` are the coefficients of a polynomial in the
    time, for the movement from the start."""
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
