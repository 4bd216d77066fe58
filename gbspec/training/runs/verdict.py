"""The verdict on a fit: whether whole solutions follow the data better than predictors that know no model."""

from __future__ import annotations

from collections.abc import Mapping

from gbspec.runs import ChannelRecord

WORTHWHILE = 0.1
"""A fit must remove at least this fraction of the mean squared error of the best naive predictor."""

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
