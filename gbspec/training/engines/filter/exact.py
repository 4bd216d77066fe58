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
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from gbspec.arrays import Array
from gbspec.ir import Linear
from gbspec.training.engines.filter.local import Evaluated, Local, Parts, evaluate
from gbspec.training.problem import Integers

SMALL = 0.25
"""Norm of Fh / 2^j at which the series begins."""
TERMS = 16
"""Terms of the series: the first one left out is below 1e-18."""


@dataclass
class Exact:
    """Legs of one sub-step of a linear model."""

    local: Local
    linear: Linear
    doublings: int = field(default=0, init=False)

    def evaluate(self, z: Tensor, k: Tensor, w: Tensor, data: Parts, derivatives: bool) -> Evaluated:
        """Mean, transition and added covariance of legs from `z` [B, n]; data as for `Local.leg`."""
        t, h, u, doses, condition = data
        first, group = self._groups(k, h, u, condition)
        ku, hu, uu, cu = k[first], h[first, 0], u[first, 0, 0], condition[first]
        self.doublings = self._needed(ku, w, hu, uu, cu)
        dummy = z.new_zeros((len(first), 0))
        flow = evaluate(self._flow, dummy, ku, w, (hu, uu, cu), derivatives)
        push = evaluate(self._push, z[:, :0], k, w, (t[:, 0], h[:, 0], u[:, 0], doses[:, 0], condition), derivatives)
        which = torch.from_numpy(group)
        a, q, *j = (part[which] for part in flow.parts)
        b = push.parts
        start = z + b[-1]
        mean = _times(a, start) + sum(_times(ji, bi) for ji, bi in zip(j, b[:-1], strict=True))
        if not derivatives:
            return Evaluated((mean, a, q))

        def combined(of_flow: Parts, of_push: Parts) -> Parts:
            da, dq, *dj = (part[which] for part in of_flow)
            change = _along(da, start) + torch.matmul(a, of_push[-1])
            for ji, bi, dji, dbi in zip(j, b[:-1], dj, of_push[:-1], strict=True):
                change = change + _along(dji, bi) + torch.matmul(ji, dbi)
            return change, da, dq

        n = z.shape[1]
        by_state = (a, z.new_zeros((len(z), n, n, n)), z.new_zeros((len(z), n, n, n)))
        by_weight = combined(flow.by_weight, push.by_weight) if len(w) else ()
        return Evaluated((mean, a, q), by_state, combined(flow.by_constant, push.by_constant), by_weight)

    def _groups(self, k: Tensor, h: Tensor, u: Tensor, condition: Tensor) -> tuple[Tensor, Integers]:
        """The first leg of each group of legs with the same factors and length, and the group of each leg."""
        inputs = u[:, 0, 0][:, list(self.linear.inputs)]
        key = np.concatenate([k.numpy(), condition.numpy(), inputs.numpy(), _rounded(h[:, :1].numpy())], axis=1)
        _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
        return torch.from_numpy(first), group.reshape(-1).astype(np.int64)

    def _needed(self, k: Tensor, w: Tensor, h: Tensor, u: Tensor, condition: Tensor) -> int:
        """The number of doublings for these groups."""
        with torch.no_grad():
            factors = vmap(self._factors, in_dims=(0, None, 0, 0))(k, w, u, condition)
        size = float((factors.abs().sum(-1).amax(-1) * h).max()) if len(h) else 0.0
        return min(max(math.ceil(math.log2(size / SMALL)), 0), 60) if 0 < size < math.inf else 0

    def _factors(self, k: Tensor, w: Tensor, u: Tensor, condition: Tensor) -> Tensor:
        """F [n, n]: the derivative of the balances with respect to the states."""
        drift = self.local.dynamics(condition, k, w).field()
        zero = k.new_zeros(len(self.local.problem.model.states))
        found: Any = jacfwd(lambda x: drift(k.new_zeros(()), x, u))(zero)
        return found  # type: ignore[no-any-return]

    def _flow(self, z: Tensor, k: Tensor, w: Tensor, h: Tensor, u: Tensor, condition: Tensor) -> Parts:
        """e^{Fh} and Q, J0 and, where they are needed, J1 and J2."""
        f = self._factors(k, w, u, condition)
        n = f.shape[-1]
        spread = self.local.dynamics(condition, k, w).spread(f.new_zeros(n), u)
        one, d = torch.eye(n, dtype=f.dtype), torch.diag(spread**2)
        s = h / 2.0**self.doublings
        orders = 1 if self.linear.steady else 3
        e, q = torch.zeros_like(f), torch.zeros_like(f)
        j = [torch.zeros_like(f) for _ in range(orders)]
        power, lie = one, d
        for i in range(TERMS):
            q = q + lie * (s ** (i + 1) / math.factorial(i + 1))
            for order in range(orders):
                scale = math.factorial(order) / math.factorial(i + order + 1)
                j[order] = j[order] + power * (scale * s ** (i + order + 1))
            power = f @ power
            e = e + power * (s ** (i + 1) / math.factorial(i + 1))
            lie = f @ lie + lie @ f.transpose(-1, -2)
        for _ in range(self.doublings):
            a = one + e
            q = q + a @ q @ a.transpose(-1, -2)
            if orders == 3:
                j[2] = j[2] + a @ j[2] + 2 * s * j[1] + s**2 * j[0]
                j[1] = j[1] + a @ j[1] + s * j[0]
            j[0] = 2 * j[0] + e @ j[0]
            e = 2 * e + e @ e
            s = 2 * s
        return (one + e, q, *j)

    def _push(
        self, z: Tensor, k: Tensor, w: Tensor, t: Tensor, h: Tensor, u: Tensor, doses: Tensor, condition: Tensor
    ) -> Parts:
        """The coefficients of b(s) = b0 + b1 s + b2 s^2 (or b0 alone), and what doses add at the start."""
        dynamics = self.local.dynamics(condition, k, w)
        drift, zero = dynamics.field(), k.new_zeros(len(self.local.problem.model.states))
        added = dynamics.dosed(zero, doses) if doses.shape[-1] else zero
        begin = drift(t, zero, u[0])
        if self.linear.steady:
            return begin, added
        middle, end = drift(t + 0.5 * h, zero, 0.5 * (u[0] + u[-1])), drift(t + h, zero, u[-1])
        length = torch.where(h > 0, h, torch.ones_like(h))
        first = (4 * middle - 3 * begin - end) / length
        return begin, first, 2 * (begin - 2 * middle + end) / length**2, added


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return torch.matmul(matrix, vector[..., None])[..., 0]


def _along(change: Tensor, vector: Tensor) -> Tensor:
    """Derivatives [B, n, n, p] of matrices, times vectors [B, n]: [B, n, p]."""
    return torch.einsum("bijp,bj->bip", change, vector)


def _rounded(lengths: Array) -> Array:
    """Lengths without the last digits, in which equal intervals of a table differ."""
    with np.errstate(divide="ignore"):
        digits = 11 - np.floor(np.log10(np.where(lengths > 0, lengths, 1.0)))
    return np.asarray(np.round(lengths * 10.0**digits) / 10.0**digits)
