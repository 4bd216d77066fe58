"""How long a fit may still take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gbspec.runs import StageRecord


def seconds_left(
    before: Sequence[StageRecord], totals: Mapping[str, int], seconds: float, taken: int, total: int, later: int
) -> float | None:
    """An estimate for a stage that has taken `taken` of `total` iterations in so many seconds, before stages with at
    most `later` iterations; None where nothing tells the pace of any.

    Most stages converge long before their last iteration: the share that those of several iterations needed so far is
    expected of the others, at the pace that these had. `totals` has the largest numbers by stage.
    """
    pace = seconds / max(taken, 1)
    several = [one for one in before if totals.get(one.name, 1) > 1 and one.iterations]
    most = sum(totals[one.name] for one in several)
    if not several and total == 1:
        return None
    if not several:
        return pace * (max(total - taken, 0) + later)
    iterations = sum(one.iterations for one in several)
    share, usual = min(iterations / most, 1.0), sum(one.seconds for one in several) / iterations
    return share * (pace * max(total - taken, 0) + usual * later)
