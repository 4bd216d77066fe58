"""Learned constants by which what is fitted has no derivative: what is said of them at the end of a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from gbspec.ir import Learnable, Model
from gbspec.training.recipe import Context, only_in_jumps
from gbspec.training.runs.constants import EXACT, covers, inside_bounds
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.verdict import named_inseparable
from gbspec.training.stages import StageName

EXACTLY = 1e-9
"""A constant that differs from its start by less, as a part of it, has not moved."""

_SEARCHES = frozenset({StageName.SEARCH, StageName.SEARCH_STARTS})
_GIVEN = "the intervals of the others, which take it for known, are too narrow"


def unmoved(model: Model, constants: Mapping[str, float], sd: Mapping[str, float], stages: Sequence[str]) -> list[str]:
    """The constants of all trajectories that ended exactly at their starts and have no standard deviation, or one that
    says no more than their bounds. Those whose values were searched for one by one are none of these."""
    sought = only_in_jumps(model) if StageName.JUMPS in stages else ()
    return [
        k.name
        for k in model.learnables
        if of_all(k)
        and k.name in constants
        and k.name not in sought
        and math.isclose(constants[k.name], k.start, rel_tol=EXACTLY, abs_tol=1e-300)
        and _open(k, constants[k.name], sd.get(k.name, math.nan))
    ]


def of_all(learnable: Learnable) -> bool:
    """Whether it is a constant of all trajectories, or one with a median of them all; an effect has none."""
    made = learnable.distribution
    return bool(made.median) if made is not None else not learnable.per_trajectory


def _open(learnable: Learnable, value: float, sd: float) -> bool:
    """Whether a standard deviation says nothing of a constant: a weak prior leaves those without a derivative one."""
    if not math.isfinite(sd):
        return True
    return covers(learnable, inside_bounds(learnable, value, sd)) if learnable.range.bounded else sd >= abs(value)


def without_unmoved(result: MemberResult, context: Context, stages: Sequence[str]) -> list[str]:
    """Takes their correlations from constants that no step has moved; a sentence for each of these, and for each whose
    value was only searched for. `stages` are those that led to the result. Those that no data can show are left to the
    warnings of the model: nothing but another model helps."""
    model = context.model
    jumping, blind = only_in_jumps(model), only_in_jumps(context.solved)
    known = result.population
    if known is not None and not (known.maximum or known.held):  # of such a fit nothing is an estimate
        return []
    still, out = unmoved(model, result.constants, result.sd, stages), []
    if result.loss <= EXACT or len(still) == len(model.learnables) > 1:  # begun at the truth, or not begun at all
        return []
    shared = [k.name for k in model.learnables if not k.per_trajectory]
    if result.correlations.shape == (len(shared), len(shared)):
        places = [i for i, name in enumerate(shared) if name in still]
        result.correlations[places], result.correlations[:, places] = 0.0, 0.0
        result.correlations[places, places] = 1.0
    result.sd |= dict.fromkeys(still, math.nan)
    unseen = named_inseparable(model) if set(still) - set(jumping) else set()
    for k in model.learnables:
        name, value = k.name, result.constants.get(k.name, math.nan)
        if name in still and name in blind and (model.marginal or model.diffusions):
            out.append(
                f"`{name}` was not learned: it occurs only where values jump, so that what is fitted has no derivative "
                f"by it, and it stayed at its start, {value:.5g}. It is no estimate, and has no interval; {_GIVEN}. "
                f"{_other_way(model, name)}"
            )
        elif name in unseen and name in still:
            continue
        elif name in still:
            passed = ", a start that solutions pass" if name in jumping else ", another start"
            out.append(
                f"`{name}` was not learned: what is fitted has no derivative by it, so that it stayed at its start, "
                f"{value:.5g}. It is no estimate, and has no interval. Data that show it{passed}, or a value (`const`) "
                "help"
            )
        elif name in jumping and name not in blind and _without_interval(result, k) and not _told(result, name):
            out.append(
                f"`{name}` has no interval: it occurs only where values jump, and the data do not show that place near "
                f"{value:.5g}; {_GIVEN}. Data that show it, or a start that solutions pass, help"
            )
        elif name in blind and _without_interval(result, k) and not _told(result, name):
            found = f"{value:.5g} is the best of the values that were tried, and " if _tried(stages) else ""
            out.append(
                f"`{name}` has no interval: it occurs only where values jump, so that what is fitted has no derivative "
                f"by it; {found}{_GIVEN}. {_other_way(model, name)}"
            )
    return out


def _without_interval(result: MemberResult, learnable: Learnable) -> bool:
    """Whether a constant of all trajectories has no standard deviation; single trajectories have their own ones."""
    return of_all(learnable) and not math.isfinite(result.sd.get(learnable.name, math.nan))


def _tried(stages: Sequence[str]) -> bool:
    """Whether the values of constants without a derivative were only searched for: no steps ended where values jump."""
    return StageName.JUMPS in stages or (not _SEARCHES.isdisjoint(stages) and StageName.CUT not in stages)


def _told(result: MemberResult, name: str) -> bool:
    return any(f"`{name}`" in text and "no interval" in text for text in result.tied)


def _other_way(model: Model, name: str) -> str:
    """What can be written for a constant by which there is a derivative."""
    smooth = f"a smooth switch, `1/(1 + exp(-(x - {name})/width))`"
    lag = f"`dose … lag {name}` if it is a lag of doses"
    if model.diffusions:
        return f"What has an interval: {smooth}"
    return f"What has an interval: {lag}, {smooth}" + ("" if model.marginal else ", or an `event` at this time")
