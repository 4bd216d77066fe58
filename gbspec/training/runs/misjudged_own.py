"""Constants of single trajectories whose intervals, by the curvature, cover their bounds: whether the data hold them.

The test is that of constants that trajectories share (`misjudged`), for each trajectory by itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from gbspec.ir import Learnable, Model
from gbspec.training.runs.constants import covers, half_width, inside_bounds, listed_own
from gbspec.training.runs.deviance import Deviance
from gbspec.training.runs.summary import MemberResult

MOST = 60
"""So many constants of single trajectories are tested; of a fit with more open ones, none beyond."""


@dataclass(frozen=True)
class Own:
    """A constant that trajectories have for themselves: its place among these, and the trajectory."""

    learnable: Learnable
    place: int
    trajectory: int


def open_own(result: MemberResult, model: Model) -> list[Own]:
    """Those whose intervals cover their bounds, trajectory by trajectory."""
    own = [k.individual for k in model.learnables if k.per_trajectory and k.distribution is None]
    if result.own_sd.shape[1] != len(own):
        return []
    half, found = half_width([result]), []
    for i, row in enumerate(result.own_sd):
        for j, (learnable, sd) in enumerate(zip(own, row, strict=True)):
            known = math.isfinite(sd) and sd > 0
            interval = inside_bounds(learnable, result.own[i, j], sd, half) if known else None
            if covers(learnable, interval):
                found.append(Own(learnable, j, i))
    return found


def taken_own(result: MemberResult, deviance: Deviance, open_ones: Sequence[Own]) -> list[str]:
    """Takes their standard deviations from those that the data hold, where trajectories share nothing that is learned;
    a sentence of them."""
    each = ((one, deviance.alone(one.trajectory)) for one in open_ones[:MOST])
    tested = ((one, alone.held(one.learnable, one.place, _estimate(result, one))) for one, alone in each)
    held = [(one, found) for one, found in tested if found is not None]
    if not held:
        return []
    listed, (one, found) = _without(result, [one for one, _ in held]), held[0]
    worse = f"{one.learnable.name} = {' or '.join(f'{value:.3g}' for value in found.worse)} in `{_label(result, one)}`"
    return [
        f"{listed} {_HAVE[len(held) == 1]} no interval: the curvature at the estimate, from which intervals are "
        f"computed, leaves {'it' if len(held) == 1 else 'them'} open, and the data do not: with {worse}, and all else "
        "refitted, the fit is clearly worse. `gbspec profile` gives intervals of constants that are not `per "
        "trajectory`: fit one of these trajectories alone"
    ]


def taken_with_shared(result: MemberResult, open_ones: Sequence[Own]) -> list[str]:
    """Takes their standard deviations from those that are open by the curvature that misjudges shared constants; a
    sentence of them."""
    if not open_ones:
        return []
    return [
        f"{_without(result, open_ones)} {_HAVE[len(open_ones) == 1]} no interval: the curvature that misjudges "
        "constants of all trajectories says nothing there either"
    ]


_HAVE = {True: "has", False: "have"}


def _without(result: MemberResult, ones: Sequence[Own]) -> str:
    """The constants, after their standard deviations have been taken."""
    listed = dict[str, list[str]]()
    for one in ones:
        name, label = one.learnable.name, _label(result, one)
        result.own_sd[one.trajectory, one.place] = math.nan
        result.misjudged_own |= {(name, label)}
        listed.setdefault(name, []).append(label)
    return listed_own(listed)


def _label(result: MemberResult, one: Own) -> str:
    return result.labels[one.trajectory]


def _estimate(result: MemberResult, one: Own) -> float:
    return float(result.own[one.trajectory, one.place])
