"""The verdict on a fit: whether whole solutions follow the data better than predictors that know no model, and whether
what is left looks like the noise of measurements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from gbspec.runs import ChannelRecord

WORTHWHILE = 0.1
"""A fit must remove at least this fraction of the mean squared error of the best naive predictor."""

SUCCESSION = 0.5
"""Residuals whose correlation with the next ones is above this, by twice its standard error, are no noise of
measurement."""
EXACT = 1e-6
"""A fit that leaves a smaller fraction of the variance than this leaves nothing that has to be explained."""

REMEDIES = (
    "do not rely on it for simulation; what may help: a postulate or a contract for the unknown function, ranges of "
    "unmeasured states, a measured rate or another measured state, a smaller network, `--members 5`, or another model"
)


def verdicts(channels: Mapping[str, ChannelRecord]) -> list[str]:
    """A warning for each channel whose whole solutions are hardly better than the best naive predictor, or worse."""
    out = []
    for name, found in channels.items():
        if found.r2 is None or found.naive is None or 1 - found.r2 <= (1 - WORTHWHILE) * (1 - found.naive):
            continue
        compared = "worse than" if found.r2 < found.naive else "hardly better than"
        measured = f"R² {found.r2:.3g}, naive {found.naive:.3g}"
        out.append(f"whole solutions follow `{name}` {compared} {found.predictor} ({measured}): {REMEDIES}")
    return out


def widening(channels: Mapping[str, ChannelRecord]) -> float:
    """The factor by which intervals of constants and functions are widened where residuals follow one another.

    n values with the correlation r between successive ones, which falls geometrically, count like n (1 - r) / (1 + r).
    Channels that were weighed by the share of their values that counts have such intervals already.
    """
    following = _following(channels)
    return _widest(following[name] for name in following if (channels[name].share or 1.0) == 1.0)


def _widest(correlations: Iterable[tuple[float, int]]) -> float:
    """The factor of the channel with the largest correlation, from its number of pairs."""
    largest = max((min(value, 1 - 2 / pairs) for value, pairs in correlations), default=0.0)
    return math.sqrt((1 + largest) / (1 - largest))


def successions(channels: Mapping[str, ChannelRecord]) -> list[str]:
    """A warning for the channels whose residuals follow one another."""
    found = _following(channels)
    if not found:
        return []
    listed = ", ".join(f"`{name}` (correlation {value:.3g} with the next row's)" for name, (value, _) in found.items())
    return [
        f"the residuals of {listed} follow one another: they are disturbances or errors of the model, not noise of "
        f"measurement. Each row tells less than a new one would: intervals are {_widest(found.values()):.2g} times as "
        "wide as if they were independent"
    ]


def _following(channels: Mapping[str, ChannelRecord]) -> dict[str, tuple[float, int]]:
    """The channels whose residuals are correlated with the next ones: the correlation, and the number of pairs."""
    return {
        name: (one.succession, one.pairs)
        for name, one in channels.items()
        if one.succession is not None
        and one.r2 is not None
        and 1 - one.r2 > EXACT
        and one.succession > SUCCESSION + 2 / math.sqrt(max(one.pairs, 1))
    }
