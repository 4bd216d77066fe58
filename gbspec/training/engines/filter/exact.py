"""Legs of models that are linear in their states, solved exactly, however stiff they are.

With x' = F x + b(t) and the disturbance S, F and S constant in a sub-step of length h and b a parabola (a constant, if
only held inputs enter), mean and covariance at its end are

    e^{Fh} m + J0 b0 + J1 b1 + J2 b2,    e^{Fh} P e^{F'h} + Q,
    Ji = integral of e^{F(h - s)} s^i ds,    Q = integral of e^{Fs} S S' e^{F's} ds.

They are computed by their power series for h / 2^j, and doubled j times (e^{Fh} - 1 is doubled, so that no digits are
lost). Unlike van Loan's exponential of one matrix, this has no factor e^{-Fh}, which overflows for fast modes. Legs
with the same F, S and h share one computation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Linear
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.local import Arrays, Evaluated
from gbspec.training.problem import Integers

SMALL = 0.25
"""Norm of Fh / 2^j at which the series begins."""
TERMS = 16
"""Terms of the series: the first one left out is below 1e-18."""


@dataclass(frozen=True)
class _Matrices:
    """Matrices [G, n, n] with their derivatives [p, G, n, n]."""

    value: Array
    slopes: Array

    def __matmul__(self, other: _Matrices) -> _Matrices:
        return _Matrices(self.value @ other.value, self.slopes @ other.value + self.value @ other.slopes)

    def __add__(self, other: _Matrices) -> _Matrices:
        return _Matrices(self.value + other.value, self.slopes + other.slopes)

    def times(self, factor: Array | float) -> _Matrices:
        """Multiplied by numbers [G, 1, 1]."""
        return _Matrices(self.value * factor, self.slopes * factor)

    @property
    def transposed(self) -> _Matrices:
        return _Matrices(self.value.swapaxes(-1, -2), self.slopes.swapaxes(-1, -2))


@dataclass
class Exact:
    """Legs of one sub-step of a linear model."""

    functions: Functions
    linear: Linear

    def evaluate(self, z: Array, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """Mean, transition and added covariance of legs from `z` [B, n]; data as for `Local.step`."""
        _, h, u, _, condition = data
        first, group = self._groups(k, h, u, condition)
        at = (u[first, 0], condition[first])
        factors = self.functions.factors(k[first], w, at, derivatives)
        push = self.functions.push(k, w, data, derivatives)
        constants = k.shape[1]
        slopes = [
            np.concatenate(pair, axis=-1) for pair in zip(factors.by_constant, factors.by_weight, strict=True)
        ] or [np.zeros((*part.shape, 0)) for part in factors.parts]
        a, q, *j = _flow(factors.parts, slopes, h[first], 1 if self.linear.steady else 3)
        *b, added = push.parts
        start = z + added
        mean = _times(a.value[group], start)
        mean = mean + sum(_times(ji.value[group], bi) for ji, bi in zip(j, b, strict=True))
        parts = mean, a.value[group], q.value[group]
        if not derivatives:
            return Evaluated(parts)
        tables = [np.moveaxis(each.slopes, 0, -1)[group] for each in (a, q, *j)]

        def combined(columns: slice, of_push: Arrays) -> Arrays:
            da, dq, *dj = (table[..., columns] for table in tables)
            change = _along(da, start) + parts[1] @ of_push[-1]
            for ji, bi, dji, dbi in zip(j, b, dj, of_push[:-1], strict=True):
                change = change + _along(dji, bi) + ji.value[group] @ dbi
            return change, da, dq

        zero = np.zeros((*parts[1].shape, z.shape[1]))
        by_weight = combined(slice(constants, None), push.by_weight)
        return Evaluated(parts, (parts[1], zero, zero), combined(slice(constants), push.by_constant), by_weight)

    def _groups(self, k: Array, h: Array, u: Array, condition: Array) -> tuple[Integers, Integers]:
        """The first leg of each group of legs with the same factors and length, and the group of each leg."""
        key = np.concatenate([k, condition, u[:, 0][:, list(self.linear.inputs)], _rounded(h[:, None])], axis=1)
        _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
        return first.astype(np.int64), group.reshape(-1).astype(np.int64)


def _flow(factors: Arrays, slopes: list[Array], h: Array, orders: int) -> list[_Matrices]:
    """e^{Fh} and Q, and J0 or J0, J1 and J2, from F [G, n, n] and the disturbances [G, n], for G lengths `h`.

    Parameters that these do not depend on are left out of the computation.
    """
    (f_value, spread), (df, ds) = factors, slopes
    groups, n = spread.shape
    active = np.flatnonzero((df != 0).any(axis=(0, 1, 2)) | (ds != 0).any(axis=(0, 1)))
    f = _Matrices(f_value, np.moveaxis(df[..., active], -1, 0))
    one = np.eye(n)
    d = _Matrices(
        spread[:, :, None] ** 2 * one, np.moveaxis(2 * spread[..., None] * ds[..., active], -1, 0)[..., None] * one
    )
    zero = _Matrices(np.zeros((groups, n, n)), np.zeros((len(active), groups, n, n)))
    doublings = _needed(f_value, h)
    s = (h / 2.0**doublings)[:, None, None]
    e, q, j, power, lie = zero, zero, [zero] * orders, zero + _Matrices(np.tile(one, (groups, 1, 1)), zero.slopes), d
    unit = power
    for i in range(TERMS):
        q = q + lie.times(s ** (i + 1) / math.factorial(i + 1))
        for order in range(orders):
            scale = math.factorial(order) / math.factorial(i + order + 1)
            j[order] = j[order] + power.times(scale * s ** (i + order + 1))
        power = f @ power
        e = e + power.times(s ** (i + 1) / math.factorial(i + 1))
        lie = f @ lie + (f @ lie.transposed).transposed
    for _ in range(doublings):
        a = unit + e
        q = q + a @ q @ a.transposed
        if orders == 3:
            j[2] = j[2] + a @ j[2] + j[1].times(2 * s) + j[0].times(s**2)
            j[1] = j[1] + a @ j[1] + j[0].times(s)
        j[0] = j[0].times(2.0) + e @ j[0]
        e = e.times(2.0) + e @ e
        s = 2 * s
    found = []
    for each in (unit + e, q, *j):
        whole = np.zeros((df.shape[-1], groups, n, n))
        whole[active] = each.slopes
        found.append(_Matrices(each.value, whole))
    return found


def _needed(f: Array, h: Array) -> int:
    """The number of doublings for these groups."""
    size = float((np.abs(f).sum(-1).max(-1) * h).max()) if len(h) else 0.0
    return min(max(math.ceil(math.log2(size / SMALL)), 0), 60) if 0 < size < math.inf else 0


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray(np.matmul(matrix, vector[..., None])[..., 0])


def _along(change: Array, vector: Array) -> Array:
    """Derivatives [B, n, n, p] of matrices, times vectors [B, n]: [B, n, p]."""
    return np.asarray(np.einsum("bijp,bj->bip", change, vector))


def _rounded(lengths: Array) -> Array:
    """Lengths without the last digits, in which equal intervals of a table differ."""
    with np.errstate(divide="ignore"):
        digits = 11 - np.floor(np.log10(np.where(lengths > 0, lengths, 1.0)))
    return np.asarray(np.round(lengths * 10.0**digits) / 10.0**digits)
