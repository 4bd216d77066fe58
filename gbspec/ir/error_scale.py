"""The scale on which errors of a channel are judged: R², naive predictors, the worst row, correlations of residuals.

On it the noise is of about the same size everywhere, so that few large values do not outweigh all others. It is the
channel's own unit; under log-normal noise the logarithm; and of counts y of size k (Poisson's: k infinite)

    T(y) = 2 sqrt(k) arsinh(sqrt(y/k)),    2 sqrt(y) where k is infinite,

of which the noise has a standard deviation of about 1 (Anscombe, Biometrika 35, 1948, 246). The prediction f of a count
is an expectation, so it is compared by the expectation of T(Y): T(f) is larger by a part of the noise where counts are
few or k is small, and a right model would be judged by that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gbspec.ir.counts import count_quantile, count_size, counted_channels
from gbspec.ir.residual import logarithmic, stabilised

if TYPE_CHECKING:
    from gbspec.ir.model import Model

Array = NDArray[np.float64]

OF_LOGARITHMS, OF_COUNTS = "of logarithms, as the noise is", "of counts on the scale of their noise"
"""What a text says of R² on these scales."""
NODES, KNOWN = 400, 160
"""Probabilities at which an expectation takes its counts; and so many expectations, between which others lie."""
FEWEST, MOST = 1e-3, 1e4
"""Counts of smaller expectation are zeros; above the other, T(f) is as far from the expectation of T(Y) as there."""


@dataclass(frozen=True)
class ErrorScale:
    """The scale of one channel: of its own unit, of `logarithms`, or of counts of a `size` (None: not counts)."""

    logarithms: bool = False
    size: float | None = None

    def measured(self, values: Array) -> Array:
        """Measured values [...] on this scale; NaN where they have no logarithm."""
        if self.logarithms:
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.where(values > 0, np.log(values), np.nan)
        return values if self.size is None else _stabilised(values, self.size)

    def predicted(self, values: Array, least: float = np.nan, number: Array | float = 1.0) -> Array:
        """Predictions [...] on this scale: of counts the expectation of what is measured, the average of `number` of
        them. A prediction of zero or less has no logarithm (NaN), unless `least` replaces it, and is no count."""
        if self.logarithms:
            with np.errstate(divide="ignore", invalid="ignore"):
                return np.asarray(np.log(np.where(values <= 0, least, values)), dtype=np.float64)
        return values if self.size is None else _expected(values, self.size, number)

    def errors(self, measured: Array, predicted: Array, number: Array) -> Array:
        """Predictions minus averages of `number` measurements [...] on this scale, in units of those of one."""
        return np.asarray(np.sqrt(number) * (self.predicted(predicted, number=number) - self.measured(measured)))


def said_of_scales(what: str, logarithms: Sequence[str], counts: Sequence[str]) -> list[str]:
    """Lines that name the channels of which `what` is of logarithms or of counts; none if there are none."""
    each = ((logarithms, OF_LOGARITHMS), (counts, OF_COUNTS))
    return [f"{what} of {', '.join(f'`{name}`' for name in names)}: {of}" for names, of in each if names]


def error_scales(model: Model, constants: Mapping[str, float]) -> tuple[ErrorScale, ...]:
    """The scale of each channel; `constants` has the values of learnables, of which the size of counts may be one."""
    each = zip(logarithmic(model), counted_channels(model), strict=True)
    return tuple(
        ErrorScale(bool(log), count_size(model, i, constants) if counted else None)
        for i, (log, counted) in enumerate(each)
    )


def on_error_scales(
    scales: Sequence[ErrorScale], measured: Array, predicted: Array, number: Array | float = 1.0
) -> tuple[Array, Array]:
    """Measured values and predictions [R, C], each channel on its scale; `number` [R, C] of measurements in each."""
    number = np.broadcast_to(number, measured.shape)
    values, found = np.empty(measured.shape), np.empty(predicted.shape)
    for j, scale in enumerate(scales):
        values[:, j] = scale.measured(measured[:, j])
        found[:, j] = scale.predicted(predicted[:, j], number=number[:, j])
    return values, found


def _stabilised(counts: Array, size: float) -> Array:
    """T of counts [...]; what is below zero counts as zero."""
    return np.asarray(stabilised(np.maximum(counts, 0.0), size), dtype=np.float64)  # keeps NaN


def _expected(mean: Array, size: float, number: Array | float) -> Array:
    """The expectation [...] of T of averages of `number` counts with the expectations `mean`.

    The sum of n counts is a count of size n k, whose T is sqrt(n) times that of the average.
    """
    f, n = np.broadcast_arrays(mean, np.maximum(np.rint(number), 1.0))
    out = _stabilised(f, size)
    for one in np.unique(n[np.isfinite(n)]).tolist():
        here = (n == one) & np.isfinite(f)
        out[here] -= _above_expectation(f[here] * one, size * one) / one**0.5
    return np.where(f > 0, np.maximum(out, 0.0), np.where(np.isnan(f), np.nan, 0.0))


def _above_expectation(mean: Array, size: float) -> Array:
    """How much T of the expectations `mean` [m] is larger than the expectation of T, interpolated."""
    logarithms, above = _table(size)
    return np.asarray(np.interp(np.log(np.clip(mean, FEWEST, MOST)), logarithms, above), dtype=np.float64)


@lru_cache(maxsize=64)
def _table(size: float) -> tuple[Array, Array]:
    """The same at `KNOWN` expectations, with their logarithms."""
    f, middle = np.geomspace(FEWEST, MOST, KNOWN)[:, None], (np.arange(NODES) + 0.5) / NODES
    counts = count_quantile(middle, f, f + f**2 / size)
    return np.log(f[:, 0]), _stabilised(f[:, 0], size) - _stabilised(counts, size).mean(axis=1)
