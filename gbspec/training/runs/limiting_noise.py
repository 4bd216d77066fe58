"""What it means that the shape of a noise ended at its upper bound, where the noise has a limit with one constant less.

Negative binomial counts of the size k have the variance f + f²/k, that of Poisson's as k grows; Student's noise becomes
the normal one as its degrees of freedom grow.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gbspec.ir import Channel, Model
from gbspec.training.runs.summary import MemberResult

NEXT = 0.05
"""Counts are as good as Poisson's where the variance is larger by less than this part."""
NEARLY_NORMAL = 30.0
"""Degrees of freedom from which on Student's noise is as good as normal: its variance is larger by a fourteenth."""

_LIMITS = {
    "negative_binomial": ("the counts vary", "no more than Poisson's", "less than this bound says", "`noise poisson`"),
    "student": (
        "there are",
        "no more outliers than under a normal noise",
        "fewer outliers than this bound says",
        "`noise normal(…)` of the same scale",
    ),
}
"""By kind of noise: how a sentence begins, what is so at the limit, what before it, and the noise of the limit."""


def said_of_limits(
    model: Model, ended: Iterable[tuple[int, str, float]], results: Mapping[int, MemberResult]
) -> dict[tuple[int, str], str]:
    """What is said of the members' constants that `ended` at upper bounds and are shapes of noises, by member and
    name."""
    upper = {k.name: k.range.high for k in model.learnables}
    out = {}
    for member, name, bound in ended:
        shaped = [c for c in model.channels if c.noise is not None and str(c.noise.shape) == name]
        kinds = {c.noise.kind for c in shaped if c.noise is not None}
        if len(kinds) != 1 or bound != upper.get(name):
            continue
        begin, at, before, limit = _LIMITS[kinds.pop()]
        if all(_at_limit(c, bound, results[member].noise) for c in shaped):
            out[member, name] = f"{begin} {at}; {limit} says the same with one constant fewer"
        else:
            out[member, name] = f"{begin} {before}: widen it, or write {limit}, to which the noise then tends"
    return out


def _at_limit(channel: Channel, bound: float, noise: Mapping[str, float]) -> bool:
    """Whether the noise of a channel is as good as its limit; `noise` are standard deviations."""
    if channel.noise is None or channel.noise.kind == "student":
        return bound >= NEARLY_NORMAL
    return noise.get(channel.name, float("inf")) ** 2 <= NEXT * bound
