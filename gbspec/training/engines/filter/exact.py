"""Legs of models that are linear in their states, solved exactly, however stiff they are.

With x' = F x + b(t) and the disturbance S, F and S constant in a sub-step of length h and b a parabola (a constant, if
only held inputs enter), mean and covariance at its end are e^{Fh} m + J0 b0 + J1 b1 + J2 b2 and e^{Fh} P e^{F'h} + Q,
with the integrals of `propagator.py`. Legs with the same F, S and h share one computation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Linear
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.local import Arrays, Evaluated
from gbspec.training.engines.filter.propagator import Matrices, propagators
from gbspec.training.problem import Integers


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
        tables = [each.slopes.swapaxes(2, 3)[group] for each in (a, q, *j)]

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


def _flow(factors: Arrays, slopes: list[Array], h: Array, orders: int) -> list[Matrices]:
    """e^{Fh} and Q, and J0 or J0, J1 and J2, from F [G, n, n] and the disturbances [G, n], for G lengths `h`.

    Parameters that these do not depend on are left out of the computation.
    """
    (f, spread), (df, ds) = factors, slopes
    active = np.flatnonzero((df != 0).any(axis=(0, 1, 2)) | (ds != 0).any(axis=(0, 1)))
    one = np.eye(spread.shape[1])
    by_spread = (2 * spread[..., None] * ds[..., active])[:, :, :, None] * one[:, None]
    d = Matrices(spread[:, :, None] ** 2 * one, by_spread)
    found = []
    for each in propagators(Matrices(f, df[..., active].swapaxes(2, 3)), d, h, orders):
        whole = np.zeros((*spread.shape, df.shape[-1], spread.shape[1]))
        whole[:, :, active] = each.slopes
        found.append(Matrices(each.value, whole))
    return found


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
