"""How well whole solutions follow a channel: one definition for the warnings of a fit and its report."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from gbspec.runs.record import ChannelRecord

FOLLOWED, LOST = 0.9, 0.5
"""R² from which whole solutions follow a channel, and below which the fit is not to be relied on: they leave more than
half of the variance of its data."""
ENOUGH = 10
"""With fewer pairs of successive residuals nothing is known of their correlation."""


def how_followed(r2: float, records: Iterable[ChannelRecord] = ()) -> Literal["well", "in part", "badly"]:
    """How whole solutions with this R² follow a channel; one that is not a number is that of solutions that do not.

    Where residuals are not correlated with the next ones, by the `records` of the members, what is left is noise,
    however much it is, and solutions that are better than the mean follow the data in part.
    """
    if r2 >= FOLLOWED:
        return "well"
    known = list(records)
    noise = bool(known) and all(_uncorrelated(one) for one in known)
    return "in part" if r2 >= LOST or (noise and r2 > 0) else "badly"


def _uncorrelated(found: ChannelRecord) -> bool:
    enough = found.autocorrelation is not None and found.pairs >= ENOUGH
    return enough and abs(found.autocorrelation or 0.0) <= 2 / found.pairs**0.5
