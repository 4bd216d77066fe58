"""Measures of error: the norms of the paper's appendix, and RMSE, NRMSE, MAE and R2 on data.

The norms follow Appendix "Metrics Used" of the paper, in which N_n is the number of test points and N_v of variables:

    L1   = 1/(N_n N_v) sum_j sum_i |e_ij|
    L2   = 1/(N_n N_v) sum_j sqrt(sum_i e_ij^2)          (1/N_v is outside the root, as printed)
    Linf = 1/N_n sum_j max_i |e_ij|

with e the difference between truth and prediction, each scaled per variable by the minimum and the maximum of the
*truth* (as the text says; the printed formula uses those of the prediction by mistake). A variable whose truth does not
vary is divided by a fallback scale instead, and the result names it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import FLAT, error_deviation
from gbspec.files import finite
from gbspec.ir import ErrorScale


@dataclass(frozen=True)
class Norms:
    """The appendix's three norms over `points` test points.

    `failed` points could not be computed (the integration broke down): they are excluded from the norms, which
    are then not comparable. `fallback` names the variables whose truth does not vary, scaled by the fallback.
    """

    L1: float
    L2: float
    Linf: float
    points: int
    failed: int = 0
    fallback: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Keys L1, L2, Linf, then the numbers of points."""
        document: dict[str, object] = {"L1": finite(self.L1), "L2": finite(self.L2), "Linf": finite(self.Linf)}
        document["points"] = self.points
        document["failed"] = self.failed
        if self.fallback:
            document["fallback"] = list(self.fallback)
        return document

    def __str__(self) -> str:
        failed = f" ({self.failed} of {self.points + self.failed} points failed)" if self.failed else ""
        return f"L1 {self.L1:.3g}  L2 {self.L2:.3g}  Linf {self.Linf:.3g}{failed}"


def truth_scale(truth: Array, fallback: Array, flat_below: float = FLAT) -> tuple[Array, Mask]:
    """Range of each variable of `truth` [N, V], and which variables use `fallback` [V] since their range is zero.

    A range counts as zero up to `flat_below` times the fallback, or the magnitude if that is larger.
    """
    width = truth.max(axis=0) - truth.min(axis=0)
    reference = np.maximum(fallback, np.abs(truth).max(axis=0))
    flat = width <= flat_below * reference
    return np.where(flat, fallback, width), flat


def norms(truth: Array, predicted: Array, fallback: Array, names: Sequence[str], flat_below: float = FLAT) -> Norms:
    """The norms of `truth` against `predicted`, both [N, V]; `fallback` [V] scales variables without a range.

    Points (rows) at which either is not finite are counted as failed and excluded.
    """
    good = np.isfinite(truth).all(axis=1) & np.isfinite(predicted).all(axis=1)
    failed = int(np.sum(~good))
    if not good.any():
        return Norms(math.nan, math.nan, math.nan, 0, failed)
    scale, flat = truth_scale(truth[good], fallback, flat_below)
    error = np.abs((predicted[good] - truth[good]) / scale)
    points, variables = error.shape
    return Norms(
        L1=float(error.sum() / (points * variables)),
        L2=float(np.sqrt((error**2).sum(axis=1)).sum() / (points * variables)),
        Linf=float(error.max(axis=1).mean()),
        points=points,
        failed=failed,
        fallback=tuple(name for name, is_flat in zip(names, flat, strict=True) if is_flat),
    )


def relative_errors(truth: Mapping[str, float], learned: Mapping[str, float]) -> dict[str, float]:
    """|learned - truth| / |truth| of each constant; the absolute difference if the truth is zero."""
    return {name: abs(learned[name] - value) / (abs(value) if value != 0.0 else 1.0) for name, value in truth.items()}


def share_text(r2: float) -> str:
    """R² with five digits, or as many (up to seven decimals) as it takes to tell it from 1; 1 above these."""
    if 0.999995 <= r2 < 1.0 - 5e-8:
        return f"{r2:.{math.ceil(-math.log10(1.0 - r2))}f}"
    return f"{r2:.5g}"


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of one channel over `n` measured values; `rmse` and `mae` in the channel's unit.

    `nrmse` is the root mean square of the errors over the standard deviation of the measured values (their magnitude,
    if they do not vary), so that `r2 = 1 - nrmse**2`; `r2` is NaN if the values do not vary. With `logarithms` these
    two are of the logarithms of values and predictions, on which channels with log-normal noise are fitted, and leave
    out the `not_positive` predictions, which have none; with `counts` they are of counts on the scale of their noise
    (`gbspec.ir.ErrorScale`).
    """

    n: int
    rmse: float
    nrmse: float
    mae: float
    r2: float
    logarithms: bool = False
    not_positive: int = 0
    counts: bool = False

    def to_json(self) -> dict[str, object]:
        """Keys n, rmse, nrmse, mae, r2, null for an undefined number; and logarithms or counts, where these are
        compared, with not_positive, where there are such predictions."""
        document: dict[str, object] = {
            "n": self.n,
            "rmse": finite(self.rmse),
            "nrmse": finite(self.nrmse),
            "mae": finite(self.mae),
            "r2": finite(self.r2),
        }
        document |= {"logarithms": True} if self.logarithms else {"counts": True} if self.counts else {}
        return document | ({"not_positive": self.not_positive} if self.not_positive else {})


def channel_errors(
    measured: Array, predicted: Array, scale: ErrorScale | None = None, number: Array | float = 1.0
) -> ChannelErrors:
    """Errors of one channel; arrays of the same shape, NaN for values that are not compared. `scale` (default: of
    values) is that of nrmse and R², `number` how many measurements each value averages."""
    scale = scale or ErrorScale()
    logarithms, counts = scale.logarithms, scale.size is not None
    scaled = scale.measured(measured), scale.predicted(predicted, number=number)
    known = np.isfinite(scaled[0]) & np.isfinite(predicted)
    n = int(known.sum())
    if n == 0:
        return ChannelErrors(0, math.nan, math.nan, math.nan, math.nan, logarithms, counts=counts)
    difference = predicted[known] - measured[known]
    rmse, mae = float(np.sqrt(np.mean(difference**2))), float(np.mean(np.abs(difference)))
    compared = known & np.isfinite(scaled[1])
    left = n - int(compared.sum())
    if left == n:
        return ChannelErrors(n, rmse, math.nan, mae, math.nan, logarithms, left)
    values, error = scaled[0][compared], scaled[1][compared] - scaled[0][compared]
    total = float(np.sum((values - values.mean()) ** 2))
    varies = total > (FLAT * float(np.abs(values).max())) ** 2 * (n - left)
    r2 = 1.0 - float(np.sum(error**2)) / total if varies else math.nan
    nrmse = float(np.sqrt(np.mean(error**2))) / error_deviation(measured[compared], scale)
    return ChannelErrors(n, rmse, nrmse, mae, r2, logarithms, left, counts)
