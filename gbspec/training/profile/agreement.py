"""Whether a profile and the interval of the fit agree, and which of them to trust where they do not.

The fit's interval is that of a linearised model; a profile refits everything else at each value of the constant, so
that it is to be trusted where it was completed and lies around the estimate of the fit.
"""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.runs import Trust

APART = 1 / 3
"""Ends further apart than this fraction of the wider interval's half width disagree."""


@dataclass(frozen=True)
class Comparison:
    """Which interval to trust, and in words why, empty where they agree."""

    trust: Trust
    words: str = ""


@dataclass(frozen=True)
class Found:
    """What a profile has found: the best value, the ends of the interval (None: open), and whether all fits have
    converged."""

    best: float
    low: float | None
    high: float | None
    settled: bool


def compared(found: Found, value: float, interval: tuple[float, float] | None, members: int) -> Comparison:
    """The profile of one member beside `value` and `interval` of the fit of `members`."""
    mine = f"{_end(found.low)} to {_end(found.high)}"
    if interval is None:
        if not found.settled:
            return Comparison("neither", "neither the fit nor the profile, not all of whose fits converged, gives an "
                              "interval")  # fmt: skip
        return Comparison("profile", f"the fit gives no interval; that of the profile is {mine}")
    theirs = f"{interval[0]:.4g} to {interval[1]:.4g}"
    if not found.settled:
        return Comparison("fit", f"not all fits of the profile converged: the fit's interval, {theirs}, is neither "
                          "confirmed nor refuted")  # fmt: skip
    if not _disagree(found, interval):
        return Comparison("both")
    words = f"the intervals of the profile, {mine}, and of the fit, {theirs}, differ by more than a third: "
    if members > 1 and _inside(found, interval):
        return Comparison("fit", words + "trust that of the fit, which has the differences between its members too")
    words += "trust the profile, which refits everything else at each value, while the fit's is of a linearised model"
    half = (interval[1] - interval[0]) / 2
    if members == 1 and abs(found.best - value) > APART * half:
        words += (
            f"; its best value, {found.best:.4g}, is not that of the fit, {value:.4g}, which minimised another "
            "criterion (outliers and starts treated otherwise) or did not come to rest"
        )
    return Comparison("profile", words)


def _disagree(found: Found, interval: tuple[float, float]) -> bool:
    if found.low is None or found.high is None:
        return True
    wider = max(interval[1] - interval[0], found.high - found.low) / 2
    return max(abs(found.low - interval[0]), abs(found.high - interval[1])) > APART * wider


def _inside(found: Found, interval: tuple[float, float]) -> bool:
    return found.low is not None and found.high is not None and interval[0] <= found.low and found.high <= interval[1]


def _end(value: float | None) -> str:
    return "open" if value is None else f"{value:.4g}"
