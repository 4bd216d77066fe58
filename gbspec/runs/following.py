"""How well whole solutions follow a channel: one definition for the warnings of a fit and its report."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from gbspec.runs.member import ChannelRecord, LikelihoodRecord, MemberRecord

FOLLOWED, LOST = 0.9, 0.5
"""R² from which whole solutions follow a channel, and below which the fit is not to be relied on: they leave more than
half of the variance of its data."""
ENOUGH = 10
"""With fewer pairs of successive residuals nothing is known of their correlation."""
AUTOCORRELATED = 0.4
"""Residuals whose correlation with the next ones is above this, and beyond chance, are no noise of measurement."""
COLOURED = 1e-3
"""Innovations are no independent numbers where the statistic of Ljung and Box, corrected for changing variances, has a
smaller probability."""
CHANCE = 2.33
"""A correlation above so many standard errors is beyond chance: one of independent residuals is in 1 % of cases."""
SMALL_FOR_NOISE = "what is left is no larger than the stated noise"
"""What is said of a channel whose R² is small for its noise."""
EXACT = 1e-6
"""A fit that leaves a smaller fraction of the variance than this leaves nothing that has to be explained."""
NOT_INDEPENDENT = (
    "are not independent: what disturbs the system lasts longer than the time between two measurements, or the model "
    "lacks something. Intervals of constants take them for independent and may be too narrow, and predictions of many "
    "rows are poor then"
)
"""What is said of innovations by the fit, and by predictions."""


def how_followed(r2: float, records: Iterable[ChannelRecord] = ()) -> Literal["well", "in part", "badly"]:
    """How whole solutions with this R² follow a channel; one that is not a number is that of solutions that do not.

    Where residuals are not correlated with the next ones, by the `records` of the members, what is left is noise,
    however much it is, and solutions that are better than the mean follow the data in part. So do those that follow
    them to the stated noise (`as_stated`).
    """
    if r2 >= FOLLOWED:
        return "well"
    known = list(records)
    noise = bool(known) and all(_uncorrelated(one) for one in known)
    stated = bool(known) and all(one.as_stated for one in known)
    return "in part" if r2 >= LOST or (noise and r2 > 0) or stated else "badly"


def small_for_noise(records: Iterable[ChannelRecord | None]) -> bool:
    """Whether a channel is followed to the stated noise by all members, and R² is small for that noise."""
    known = list(records)
    stated = bool(known) and all(one is not None and bool(one.as_stated) for one in known)
    return stated and any(one is not None and _r2(one) < FOLLOWED for one in known)


def autocorrelated(
    channels: Mapping[str, ChannelRecord], explained: float = EXACT, above: float = AUTOCORRELATED
) -> list[str]:
    """The channels whose residuals are correlated with the next ones, by more than `above` and beyond chance, and are a
    larger fraction of the variance than `explained`."""
    return [
        name
        for name, one in channels.items()
        if one.autocorrelation is not None
        and one.r2 is not None
        and 1 - one.r2 > explained
        and one.autocorrelation > max(above, CHANCE / max(one.pairs, 1) ** 0.5)
    ]


def not_independent(channels: Mapping[str, ChannelRecord], likelihood: LikelihoodRecord) -> dict[str, float | None]:
    """The channels whose innovations are not independent, by the test of many correlations or by that with the next
    row's, with the probability of the test."""
    following = autocorrelated(channels)
    tested = {name: one.p if one.robust_p is None else one.robust_p for name, one in likelihood.whiteness.items()}
    return {
        name: p
        for name, p in ((name, tested.get(name)) for name in channels)
        if name in following or (p is not None and p < COLOURED)
    }


def said_of_training(members: Collection[MemberRecord]) -> list[str]:
    """Warnings for predictions of new rows: of the channels that no member follows in the training data, and of those
    of which all members leave autocorrelated residuals, or innovations that are not independent."""
    known = [member for member in members if member.channels]
    found = [member.channels for member in known if member.channels]
    if not found:
        return []
    names = [name for name in found[0] if all(name in each for each in found)]
    badly = [name for name in names if all(how_followed(_r2(each[name]), [each[name]]) == "badly" for each in found)]
    left = [_coloured(member) for member in known]
    coloured = [name for name in names if name not in badly and all(name in each for each in left)]
    out = []
    if badly:
        best = {name: max(_r2(each[name]) for each in found) for name in badly}
        listed = ", ".join(f"`{name}`" + (f" (R² {r2:.3g})" if math.isfinite(r2) else "") for name, r2 in best.items())
        out.append(f"the fit follows {listed} badly in the training data: do not rely on these predictions")
    if coloured:
        listed = ", ".join(f"`{name}`" for name in coloured)
        filtered = any(member.likelihood is not None for member in known)
        out.append(_of_innovations(listed) if filtered else _of_residuals(listed))
    return out


def _coloured(member: MemberRecord) -> Collection[str]:
    """The channels of which a member leaves residuals that depend on each other: with a likelihood of disturbances
    these are innovations."""
    channels = member.channels or {}
    return autocorrelated(channels) if member.likelihood is None else not_independent(channels, member.likelihood)


def _of_innovations(listed: str) -> str:
    return f"the innovations of {listed} in the training data {NOT_INDEPENDENT}"


def _of_residuals(listed: str) -> str:
    return (
        f"the residuals of {listed} in the training data are autocorrelated: the system is disturbed, or the model "
        "lacks something. Predictions of further rows are less certain than their intervals say"
    )


def _r2(found: ChannelRecord) -> float:
    """R² of a channel; that of solutions which are not finite is below all others."""
    return -math.inf if found.r2 is None else found.r2


def _uncorrelated(found: ChannelRecord) -> bool:
    enough = found.autocorrelation is not None and found.pairs >= ENOUGH
    return enough and abs(found.autocorrelation or 0.0) <= 2 / found.pairs**0.5
