"""What a run says of members that ended in minima of different depth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbspec.training.runs.summary import MemberResult

WORSE, CLEARLY, ROUNDED = 0.05, 10.0, 1e-8
"""Members are in a worse minimum if their loss is larger by this share, and -2 log likelihood by so much; losses up to
the last number are those of exact data, whose ratios say nothing."""


def said_of_minima(results: Mapping[int, MemberResult]) -> list[str]:
    """A warning where members ended in minima of different depth."""
    losses = {member: one.loss for member, one in results.items() if one.objective is None and np.isfinite(one.loss)}
    best = min(losses.values(), default=0.0)
    count = max((sum(one.values or 0 for one in r.channels.values()) for r in results.values()), default=0)
    least = best * (1 + max(WORSE, CLEARLY / max(count, 1)))
    worse = [member for member, loss in sorted(losses.items()) if loss > max(least, ROUNDED)]
    if not worse:
        return []
    listed = ", ".join(f"{member} (loss {losses[member]:.4g})" for member in worse)
    return [
        f"members ended in different minima: the best loss is {best:.4g}, worse are {listed}. Intervals contain the "
        "differences; a single fit may end in either: trust the best member, or use more of them"
    ]
