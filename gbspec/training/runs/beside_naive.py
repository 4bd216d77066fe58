"""Errors of a fit beside those of predictors that know no model: when these put it in doubt."""

from __future__ import annotations

import math

from gbspec.data import LINE
from gbspec.ir import Model
from gbspec.runs import EXACT, ChannelRecord
from gbspec.training.runs.straight import straight

WORTHWHILE = 0.1
"""A fit must remove at least this fraction of the mean squared error of the best naive predictor."""
LOST = 2.0
"""A fit with disturbances is not to be relied on whose errors one row ahead have so many times the mean square of what
knows no model."""


def squared_errors(found: ChannelRecord) -> tuple[float, float]:
    """The mean squared errors of whole solutions and of the naive predictor (if there is one), over the variance.

    A fit obeys limits too, which the naive predictor does not know and no error counts: it may be worse by as much as
    if each of them were a value with the same squared error.
    """
    limits = found.censored or 0
    known = max((found.values or 0) - limits, 1)
    error = math.inf if found.r2 is None else 1 - found.r2
    return error, (1 + limits / known) * (1 - (found.naive or 0.0))


def better(found: ChannelRecord, name: str, model: Model | None) -> bool:
    """Whether whole solutions follow a channel so well that the naive predictor does not put them in doubt: clearly
    better, or as well (up to `WORTHWHILE`) as straight lines where they can be nothing else."""
    error, of_naive = squared_errors(found)
    if error <= (1 - WORTHWHILE) * of_naive:
        return True
    as_well = found.predictor == LINE and error <= (1 + WORTHWHILE) * of_naive
    return as_well and model is not None and name in straight(model)


def worse_ahead(found: ChannelRecord) -> bool:
    """Whether predictions one row ahead follow a channel clearly worse than the naive predictor: the ratio of the mean
    squared errors is above one by more than `WORTHWHILE`, and than chance makes it: of independent errors its standard
    error is 2/sqrt(n) with n values. Exact predictions are not."""
    if found.r2 is None or found.naive is None or 1 - found.r2 <= EXACT:
        return False
    chance = 2 * 2 / math.sqrt(max(found.values or 0, 1))
    return 1 - found.r2 > (1 + max(WORTHWHILE, chance)) * (1 - found.naive)


def lost_ahead(found: ChannelRecord) -> bool:
    """Whether such predictions have more than `LOST` times the mean squared error of the naive predictor."""
    return worse_ahead(found) and 1 - (found.r2 or 0.0) > LOST * (1 - (found.naive or 0.0))
