"""Censored measurements: values of which only a limit is known, below or above which they lie.

With the residual r of the limit (`gbspec.ir.residual`; prediction minus limit, in units of which the noise has the
standard deviation l, the level), a value below the limit has the residual

    t(r) = l sqrt(-2 log Phi(-r/l)),        half its square over l^2 being minus the logarithm of the probability,

and one above it -t(-r). Where the noise is not known the level is 0: t(r) = max(r, 0), the limit of l -> 0, which only
keeps predictions on the right side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Value: TypeAlias = Any
"""An array, or a tensor: the same text serves numpy and torch, which share no type."""
Arithmetic: TypeAlias = Any
"""The module `numpy`, or `torch`."""
LEAST = 1e-300
"""Of minus twice a logarithm: below it the root has no finite derivative, and is constant."""


@dataclass(frozen=True)
class Censored:
    """Which entries [R, C] are limits: `side` is -1 where the value lies below, 1 where above, 0 where it is known;
    `level` [C] is the standard deviation of the noise in units of the residuals, 0 where it is not known."""

    side: NDArray[np.int8]
    level: NDArray[np.float64]

    def residuals(self, plain: Value, xp: Arithmetic = np) -> Value:
        """The residuals from those of known values and of limits, by numpy or torch."""
        side, violation, level, known = self._parts(plain, xp)
        exact = level * xp.sqrt(xp.clip(-2.0 * _log_probability(-violation / level, xp), LEAST, None))
        size = xp.where(known, exact, xp.clip(violation, 0.0, None))
        return xp.where(side == 0, plain, -side * size)

    def slopes(self, plain: NDArray[np.float64]) -> NDArray[np.float64]:
        """Derivatives of the residuals by those of known values and of limits."""
        side, violation, level, known = self._parts(plain, np)
        z = violation / level
        logs = _log_probability(-z, np)
        root = np.sqrt(np.clip(-2.0 * logs, LEAST, None))
        ratio = np.exp(np.minimum(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - logs, 700.0))
        exact = np.where(-2.0 * logs > LEAST, ratio / root, 0.0)
        return np.where(side == 0, 1.0, np.where(known, exact, (violation > 0).astype(np.float64)))

    def noise_terms(
        self, residuals: NDArray[np.float64], seen: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Squares and counts of the residuals [m] of the entries `seen` [R, C], whose sums have the noise's variance as
        their ratio.

        Known values have their squares and count as one. With w = -r/l, r that of the limit, a limit is expected to
        have the square l^2 (1 - w phi(w)/Phi(w)) (Tobin 1958): the first term is that of one more value, and so both
        are left out; a positive w phi/Phi counts, the negative of another one is a square. Far on its side of the
        limit a value tells nothing of the noise; far beyond it, it is a residual like others.
        """
        from scipy.special import ndtri_exp

        side, level = self.side[seen], np.broadcast_to(self.level, self.side.shape)[seen]
        known, limit = level > 0, side != 0
        logs = -0.5 * (residuals / np.where(known, level, 1.0)) ** 2
        w = ndtri_exp(np.minimum(logs, -LEAST))
        exponent = np.minimum(-0.5 * w**2 - 0.5 * np.log(2 * np.pi) - logs, 700.0)
        told = np.where(np.isfinite(w), w * np.exp(exponent), 0.0)
        squares = np.where(limit & known, level**2 * np.maximum(-told, 0.0), residuals**2)
        counts = np.where(limit, np.where(known, np.maximum(told, 0.0), (residuals != 0).astype(np.float64)), 1.0)
        return squares, counts

    def _parts(self, plain: Value, xp: Arithmetic) -> tuple[Value, Value, Value, Value]:
        """Sides, violations of the limits (0 at known values), levels (1 where not known), and where they are known."""
        side, level = self.side.astype(np.float64), np.broadcast_to(self.level, self.side.shape)
        known = level > 0
        if xp is not np:
            side, level, known = plain.new_tensor(side), plain.new_tensor(level), plain.new_tensor(known).bool()
        violation = xp.where(side == 0, xp.zeros_like(plain), -side * plain)
        return side, violation, xp.where(known, level, 1.0 + 0 * level), known


def _log_probability(z: Value, xp: Arithmetic) -> Value:
    """The logarithm of the normal distribution function."""
    if xp is not np:
        return xp.special.log_ndtr(z)
    from scipy.special import log_ndtr

    return log_ndtr(z)
