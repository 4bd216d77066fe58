"""Constants of single trajectories whose intervals, by the curvature, cover their bounds: whether the data hold them.

The test is that of constants that trajectories share (`misjudged`); of trajectories that share nothing that is learned,
for each by itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from gbspec.ir import Model
from gbspec.training.problem import Parameters
from gbspec.training.runs.constants import covers, half_width, inside_bounds
from gbspec.training.runs.deviance import Deviance, Held
from gbspec.training.runs.ended_own import Own, listed, own_constants, without_interval
from gbspec.training.runs.summary import MemberResult

MOST = 60
"""So many constants of single trajectories are tested; of a fit with more open ones, none beyond,"""
MOST_TOGETHER = 12
"""and so many where trajectories share learned constants, since each test fits all trajectories again."""


def open_own(result: MemberResult, model: Model) -> list[Own]:
    """Those whose intervals cover their bounds, trajectory by trajectory."""
    half, found = half_width([result]), []
    for one in own_constants(result, model):
        value, sd = _estimate(result, one), float(result.own_sd[one.trajectory, one.place])
        if (one.learnable.name, result.labels[one.trajectory]) in result.bounded_own:
            continue
        interval = inside_bounds(one.learnable, value, sd, half) if math.isfinite(sd) and sd > 0 else None
        if covers(one.learnable, interval):
            found.append(one)
    return found


def taken_own(result: MemberResult, deviance: Deviance, parameters: Parameters, open_ones: Sequence[Own]) -> list[str]:
    """Takes their standard deviations from those that the data hold, and keeps which ones they leave open; a sentence
    of the former."""
    tested = open_ones[: MOST_TOGETHER if parameters.n_shared else MOST]
    each = [(one, _held(one, deviance, parameters, _estimate(result, one))) for one in tested]
    left = [one for one, found in each if found is None and one.learnable.name not in deviance.unknown]
    result.open_own |= frozenset((one.learnable.name, result.labels[one.trajectory]) for one in left)
    held = [(one, found) for one, found in each if found is not None]
    if not held:
        return []
    ones, (one, found) = [one for one, _ in held], held[0]
    result.misjudged_own |= without_interval(result, ones)
    example, it, have = ("", "it", "has") if len(ones) == 1 else ("for example ", "them", "have")
    worse = f"{one.learnable.name} = {' or '.join(f'{value:.3g}' for value in found.worse)}"
    return [
        f"{listed(result, ones)} {have} no interval: the curvature at the estimate, from which intervals are computed, "
        f"leaves {it} open, and the data do not: {example}with {worse} in `{result.labels[one.trajectory]}`, and all "
        f"else refitted, the fit is clearly worse{_profiled(result, parameters)}"
    ]


def _held(one: Own, deviance: Deviance, parameters: Parameters, estimate: float) -> Held | None:
    if parameters.n_shared:
        column = parameters.n_shared + one.trajectory * parameters.n_local + one.place
        return deviance.held(one.learnable, column, estimate)
    return deviance.alone(one.trajectory).held(one.learnable, one.place, estimate)


def _profiled(result: MemberResult, parameters: Parameters) -> str:
    """How an interval can be had: `profile` has none of constants per trajectory."""
    if len(result.labels) == 1:
        return ". For an interval, fit without `per trajectory`, and use `gbspec profile`"
    if parameters.n_shared:  # what all trajectories say of those would be lost in a fit of one
        return ""
    return ". For an interval, fit one trajectory alone, without `per trajectory`, and use `gbspec profile`"


def _estimate(result: MemberResult, one: Own) -> float:
    return float(result.own[one.trajectory, one.place])
