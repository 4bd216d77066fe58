"""Constants of single trajectories that ended at a bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from gbspec.arrays import Array
from gbspec.ir import Learnable, Model
from gbspec.training.problem import Bijection, Parameters
from gbspec.training.recipe import Context
from gbspec.training.runs.constants import EXACT, listed_own, lost
from gbspec.training.runs.summary import MemberResult


@dataclass(frozen=True)
class Own:
    """A constant that trajectories have for themselves: its place among these, and the trajectory."""

    learnable: Learnable
    place: int
    trajectory: int


def own_constants(result: MemberResult, model: Model) -> list[Own]:
    """Those without a distribution, trajectory by trajectory; none where their standard deviations are not computed."""
    own = [k for k in model.learnables if k.per_trajectory and k.distribution is None]
    if result.own_sd.shape[1] != len(own):
        return []
    return [Own(k, j, i) for i in range(len(result.own_sd)) for j, k in enumerate(own)]


def without_interval(result: MemberResult, ones: Sequence[Own]) -> frozenset[tuple[str, str]]:
    """Takes their standard deviations from constants; their names with the labels of the trajectories."""
    for one in ones:
        result.own_sd[one.trajectory, one.place] = math.nan
    return frozenset((one.learnable.name, result.labels[one.trajectory]) for one in ones)


def listed(result: MemberResult, ones: Sequence[Own]) -> str:
    """The constants, each with the trajectories."""
    found = dict[str, list[str]]()
    for one in ones:
        found.setdefault(one.learnable.name, []).append(result.labels[one.trajectory])
    return listed_own(found)


def without_own_at_bounds(
    result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
) -> list[str]:
    """Takes their standard deviations, which are not valid there, from constants of single trajectories that ended at
    bounds; what is to be said of them, bound by bound."""
    if not result.loss > EXACT:  # nothing holds back a fit without residuals
        return []
    ended = dict[tuple[int, float], list[Own]]()
    for one in own_constants(result, context.model):
        value, sd = (float(known[one.trajectory, one.place]) for known in (result.own, result.own_sd))
        bound = Bijection.of(one.learnable).ended_at(value, sd)
        if bound is not None:
            ended.setdefault((one.place, bound), []).append(one)
    result.bounded_own |= without_interval(result, [one for ones in ended.values() for one in ones])
    astray = bool(lost({0: result}))
    return [
        f"{listed(result, ones)} ended at {_meaning(bound, len(ones), astray)}" for (_, bound), ones in ended.items()
    ]


def _meaning(bound: float, count: int, astray: bool) -> str:
    whose = "its bound" if count == 1 else "their bound"
    if astray:
        said = "since solutions do not follow the data, that says nothing of where the constant lies"
    else:
        said = "the data do not need it" if not bound else "widen the bounds if values beyond it are plausible"
    return f"{whose} {bound:g}, where no interval holds; {said}"
