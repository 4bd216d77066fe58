"""What a profile says of fits that are better than the run's, and of other constants that end at bounds."""

from __future__ import annotations

from collections.abc import Mapping

from gbspec.ir import Model
from gbspec.training.profile.result import ProfilePoint
from gbspec.training.runs import at_bounds

BETTER = 1.0
"""Deviances lower by this are those of another, better fit: iterations that had not come to rest leave much less."""
LISTED = 8
"""The most starting values that are listed."""


NOTICED = 0.1
"""Estimates further apart than this many standard deviations are told apart."""


def said_of_estimate(name: str, fitted: float, estimate: float, deviations: float, functions: bool) -> list[str]:
    """A note where the `estimate` of a profile is so many standard `deviations` from the value `fitted` of the run, as
    it minimises another criterion; `functions`: whether the model has unknown functions."""
    if not deviations > NOTICED:
        return []
    near = ", and the weights of functions held near those of the run" if functions else ""
    return [
        f"its estimate, {name} = {estimate:.4g}, is not that of the fit, {fitted:.4g}: before {name} was fixed, it was "
        f"refitted with all else by least squares of whole solutions, with outliers counted in full{near}. Deviances "
        "count from there"
    ]


def said_of_better(name: str, begun: ProfilePoint, least: ProfilePoint) -> list[str]:
    """A note where the best fit of a profile is better than the one from which it `begun`, which is the run's."""
    lower = begun.deviance - least.deviance
    if not lower > BETTER:
        return []
    values = {name: least.value, **least.others}
    listed = ", ".join(f"`{key} = {value:.5g}`" for key, value in [*values.items()][:LISTED])
    more = ", …" if len(values) > LISTED else ""
    return [
        f"the run's fit (refitted: {name} = {begun.value:.4g}) is not the best one: with {name} = {least.value:.4g} "
        f"the deviance is lower by {lower:.3g}, and the deviances above count from there. Train again from these "
        f"starting values of `learn`: {listed}{more}"
    ]


def said_of_bounds(model: Model, name: str, estimate: Mapping[str, float], side: tuple[ProfilePoint, ...]) -> list[str]:
    """A note of the first fit outwards on one side in which other constants are at bounds that they do not have at the
    `estimate`: from there on the profile is that of their ranges."""
    before = {one for one, _ in at_bounds(model, estimate)}
    for point in side:
        ended = [(one, bound) for one, bound in at_bounds(model, point.others) if one not in before]
        if ended:
            listed = ", ".join(f"`{one}` at its bound {bound:g}" for one, bound in ended)
            return [
                f"at {name} = {point.value:.4g} the fit has {listed}: there the profile, and an end of the interval "
                "beyond the value before, are those of this range as well; widen it if it is not meant"
            ]
    return []
