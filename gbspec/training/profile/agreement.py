"""Whether a profile and the interval of the fit agree, and which of them to trust where they do not.

The fit's interval is that of a linearised model; a profile refits everything else at each value of the constant, so
that it is to be trusted where it was completed and lies around the estimate of the fit. A prior that was raised so that
the fits converge holds everything else in place: a profile that is much narrower for this reason tells nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.runs import Trust

APART = 1 / 3
"""Ends further apart than this fraction of the wider interval's half width disagree."""
NARROWED = 0.2
"""If a raised prior narrows the interval by more than this fraction, the profile is not to be trusted."""

OTHER_BEST = "is not that of the fit"
"""What is said of a best value that is another one than the fit's."""


@dataclass(frozen=True)
class Comparison:
    """Which interval to trust, and in words why, empty where they agree."""

    trust: Trust
    words: str = ""


@dataclass(frozen=True)
class Found:
    """What a profile has found: the best value, the ends of the interval (None: open), whether all fits have
    converged, and the fraction by which a raised prior of the weights narrows the interval."""

    best: float
    low: float | None
    high: float | None
    settled: bool
    narrowed: float = 0.0


def narrowing(factor: float, narrowed: float) -> str:
    """The note on a prior whose precision was raised by a factor."""
    return (
        f"the precision of the weights' prior was raised to {factor:g} times that of the evidence so that the fits "
        f"converge: according to the linearised fit the interval is {100 * narrowed:.1f} % narrower"
    )


def compared(found: Found, value: float, interval: tuple[float, float] | None, members: int) -> Comparison:
    """The profile of one member beside `value` and `interval` of the fit of `members`."""
    mine = f"{_end(found.low)} to {_end(found.high)}"
    if found.narrowed > NARROWED:
        return Comparison("neither", _held_in_place(found, mine, interval))
    if interval is None:
        if not found.settled:
            return Comparison("neither", "neither the fit nor the profile, not all of whose fits converged, gives an "
                              "interval")  # fmt: skip
        return Comparison("profile", f"the fit gives no interval; that of the profile is {mine}")
    theirs = _interval(interval)
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
            f"; its best value, {found.best:.4g}, {OTHER_BEST}, {value:.4g}, which minimised another "
            "criterion (outliers and starts treated otherwise) or did not come to rest"
        )
    return Comparison("profile", words)


def _held_in_place(found: Found, mine: str, interval: tuple[float, float] | None) -> str:
    """Why neither interval is to be relied on where a raised prior makes that of the profile much narrower."""
    ends = mine if found.settled else "not all of whose fits converged"
    fits = "; the fit gives no interval" if interval is None else f", nor the fit's interval, {_interval(interval)}"
    return (
        f"trust neither the profile, {ends}, which the raised prior of the weights makes {100 * found.narrowed:.0f} % "
        f"narrower{fits}: the data hardly determine the constant together with the functions and the other constants; "
        "fix or measure one of those that are correlated with it"
    )


def _interval(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.4g} to {ends[1]:.4g}"


def _disagree(found: Found, interval: tuple[float, float]) -> bool:
    if found.low is None or found.high is None:
        return True
    wider = max(interval[1] - interval[0], found.high - found.low) / 2
    return max(abs(found.low - interval[0]), abs(found.high - interval[1])) > APART * wider


def _inside(found: Found, interval: tuple[float, float]) -> bool:
    return found.low is not None and found.high is not None and interval[0] <= found.low and found.high <= interval[1]


def _end(value: float | None) -> str:
    return "open" if value is None else f"{value:.4g}"
