"""Diagrams of all members of an ensemble: for each special point that all have, the interval of its values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gbspec.analysis.bifurcation.diagram import Diagram


def with_intervals(diagrams: Sequence[Diagram]) -> Diagram:
    """The first diagram with an interval for each fold and Hopf point: the range of the closest points of all members.

    The interval stays None if some member has no such point: the members then disagree on its existence.
    """
    first, others = diagrams[0], diagrams[1:]
    special = []
    for point in first.special:
        values = [point.value]
        order = sorted(one.value for one in first.special if one.kind == point.kind)
        for other in others:
            same = sorted(one.value for one in other.special if one.kind == point.kind)
            if len(same) == len(order):
                values.append(same[order.index(point.value)])
        complete = bool(others) and len(values) == len(diagrams)
        special.append(replace(point, interval=(min(values), max(values)) if complete else None))
    return replace(first, special=tuple(special))
