"""Diagrams of all members of an ensemble: for each special point that all have, the interval of its values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gbspec.analysis.bifurcation.continuation import SpecialPoint
from gbspec.analysis.bifurcation.diagram import Diagram
from gbspec.runs import NORMAL_90


def with_intervals(diagrams: Sequence[Diagram]) -> Diagram:
    """The first diagram with an interval for each fold and Hopf point, from the closest points of all members.

    It is a 90 % interval around the mean, from the variances within and between members, where all members have a
    standard deviation; the range of the values otherwise. It is None if some member has no such point: the members then
    disagree on its existence.
    """
    first, others = diagrams[0], diagrams[1:]
    special = []
    for point in first.special:
        alike = [point]
        order = sorted(one.value for one in first.special if one.kind == point.kind)
        for other in others:
            same = sorted((one for one in other.special if one.kind == point.kind), key=lambda one: one.value)
            if len(same) == len(order):
                alike.append(same[order.index(point.value)])
        complete = bool(others) and len(alike) == len(diagrams)
        special.append(_together(alike) if complete else replace(point, interval=None, sd=None))
    return replace(first, special=tuple(special))


def _together(alike: Sequence[SpecialPoint]) -> SpecialPoint:
    """The first of the members' points, with the interval of all."""
    values = np.array([one.value for one in alike])
    low, high = float(values.min()), float(values.max())
    within = [one.sd for one in alike if one.sd is not None]
    if len(within) < len(alike):
        return replace(alike[0], interval=(low, high), sd=None)
    sd = float(np.sqrt(np.mean(np.square(within)) + values.var(ddof=1)))
    mean = float(values.mean())
    return replace(alike[0], interval=(min(mean - NORMAL_90 * sd, low), max(mean + NORMAL_90 * sd, high)), sd=sd)
