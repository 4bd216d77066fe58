"""The residual: the single definition used by fits, reports, studies and the native kernel.

For a measured value y with prediction p, scale s and weight w (the square root of the number of measurements that y
averages; 0 where nothing was measured; `gbspec.data.scales_of` gives s and w)

    r = w (p - y) / s

and for a channel with log-normal noise, whose scale is that of logarithms,

    r = w ln(p / |y|) / s,    continued below p = LOG_FLOOR |y| by its tangent, with |y| at least LEAST_SIZE,

so that predictions that become negative during a fit have a finite residual that still falls towards the data. Where
counts of size k (Poisson's: infinite) are compared on the scale of their noise, whose standard deviation is then about
1 (Anscombe, Biometrika 35, 1948, 246),

    r = w (T(p) - T(y)) / s,    T(x) = 2 sqrt(k) arsinh(sqrt((x + COUNT_SHIFT)/k)),    2 sqrt(x + COUNT_SHIFT),

continued below p = 0 by its tangent.
The sign is that of prediction minus measurement. Half the sum of squares of r / (standard deviation of the noise in
units of r) is the negative log likelihood up to terms that do not depend on p.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gbspec.ir.censoring import Arithmetic, Censored, Value

if TYPE_CHECKING:
    from gbspec.ir.model import Model

LOG_FLOOR = 1e-3
"""Below this fraction of the measured value, the logarithm of a prediction is continued by its tangent."""
LEAST_SIZE = 1e-300
"""Replaces the size of a measured zero, which has no logarithm."""
COUNT_SHIFT = 0.375
"""What is added to counts, so that those of small expectation have about the same noise as others."""
LEAST_PREDICTED = float(np.finfo(np.float64).tiny)
"""Replaces predictions of zero or less where R² of a fit is not to leave them out: they are as bad as can be."""


def logarithmic(model: Model) -> NDArray[np.bool_]:
    """Which channels [C] have residuals of logarithms."""
    return np.array([c.noise is not None and c.noise.kind == "lognormal" for c in model.channels], dtype=np.bool_)


def residuals(
    predicted: Value,
    measured: Value,
    factor: Value,
    logarithmic: NDArray[np.bool_],
    xp: Arithmetic = np,
    censored: Censored | None = None,
    sizes: NDArray[np.float64] | None = None,
) -> Value:
    """Residuals [..., C] of `predicted` and `measured` [..., C] (any number where nothing was
    measured; NaN there gives NaN where the factor is positive).

    `factor` [..., C] is w / s, 0 where nothing was measured: the residual is then 0 for any prediction.
    `logarithmic` [C]: which channels have log-normal noise. `xp` is numpy for arrays or torch for tensors. `censored`:
    which of the measured values are limits (`gbspec.ir.censoring`). `sizes` [C]: of counts that are compared on the
    scale of their noise, 0 of other channels (None: none are).
    """
    difference = predicted - measured
    if sizes is not None:
        found = _continued(predicted, sizes, xp) - _continued(measured, sizes, xp)
        difference = xp.where(_like(predicted, sizes > 0, xp), found, difference)
    if logarithmic.any():
        logs = _like(predicted, logarithmic, xp)
        # Elsewhere the quotient is 1: that of large numbers by a measured zero overflows.
        ratio = xp.where(logs, predicted, 1.0) / xp.where(logs, xp.clip(xp.abs(measured), LEAST_SIZE, None), 1.0)
        safe = xp.clip(ratio, LOG_FLOOR, None)
        difference = xp.where(logs, xp.log(safe) + (ratio - safe) / LOG_FLOOR, difference)
    plain = xp.where(factor > 0, difference * factor, xp.zeros_like(difference))
    return plain if censored is None else censored.residuals(plain, xp)


def slopes(
    predicted: Value,
    measured: Value,
    factor: Value,
    logarithmic: NDArray[np.bool_],
    xp: Arithmetic = np,
    censored: Censored | None = None,
    sizes: NDArray[np.float64] | None = None,
) -> Value:
    """Derivatives of the residuals with respect to the predictions [..., C]; arguments as in `residuals`."""
    out = factor + xp.zeros_like(predicted)
    if sizes is not None:
        size, counted = _sizes(predicted, sizes, xp)
        shifted = xp.clip(predicted, 0.0, None) + COUNT_SHIFT
        out = xp.where(counted, factor / xp.sqrt(shifted * (1 + shifted / size)), out)
    if logarithmic.any():
        logs = _like(predicted, logarithmic, xp)
        size = xp.where(logs, xp.clip(xp.abs(measured), LEAST_SIZE, None), 1.0)
        slope = factor / (size * xp.clip(xp.where(logs, predicted, 1.0) / size, LOG_FLOOR, None))
        out = xp.where(logs, slope, out)
    if censored is None:
        return out
    return out * censored.slopes(residuals(predicted, measured, factor, logarithmic, xp, sizes=sizes))


def stabilised(counts: Value, size: Value, shift: float = 0.0, xp: Arithmetic = np) -> Value:
    """T of counts [...], none of which is below zero, of a size (infinite: Poisson's), with what is added to them."""
    known = xp.where(xp.isfinite(size), size, 1.0)
    root = xp.sqrt(counts + shift)
    return 2 * xp.where(xp.isfinite(size), xp.sqrt(known) * xp.arcsinh(root / xp.sqrt(known)), root)


def _continued(values: Value, sizes: NDArray[np.float64], xp: Arithmetic) -> Value:
    """T of values [..., C] of counts of these sizes [C], continued below zero."""
    size, _ = _sizes(values, sizes, xp)
    found = stabilised(xp.clip(values, 0.0, None), size, COUNT_SHIFT, xp)
    return found + xp.clip(values, None, 0.0) / xp.sqrt(COUNT_SHIFT * (1 + COUNT_SHIFT / size))


def _sizes(like: Value, sizes: NDArray[np.float64], xp: Arithmetic) -> tuple[Value, Value]:
    """Sizes of counts of the type of `like` (infinite where there are none), and which channels are counts."""
    found = np.where(sizes > 0, sizes, np.inf)
    return found if xp is np else like.new_tensor(found), _like(like, sizes > 0, xp)


def _like(predicted: Value, mask: NDArray[np.bool_], xp: Arithmetic) -> Value:
    """A mask of the type of `predicted`: an array, or a tensor on its device."""
    return mask if xp is np else predicted.new_tensor(mask, dtype=xp.bool)
