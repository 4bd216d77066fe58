"""Whether the conditions of a `piecewise` leave out nothing, so that one without `otherwise` has a value everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from gbspec.imports.computing import NotConstantError, value_of
from gbspec.imports.formulas import FALSE, TRUE, Formula, compared, number, substituted, walk

_MIRRORED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "=="}


def exhaustive(conditions: Sequence[Formula]) -> bool:
    """Whether one of the conditions holds everywhere. Found out where all of them compare one quantity with numbers, or
    the same two quantities with each other; else False."""
    found = [_normal(node) for condition in conditions for node in walk(condition) if node.head in _MIRRORED]
    if len({subject for subject, _, _ in found}) != 1:
        return False
    ends = sorted({level for _, _, level in found})
    points = (ends[0] - 1, *ends, *((a + b) / 2 for a, b in pairwise(ends)), ends[-1] + 1)
    return all(any(_holds(condition, x) for condition in conditions) for x in points)


def _normal(node: Formula) -> tuple[Formula, str, float]:
    """A comparison as one of a subject with a number; of two quantities it is their difference, compared with 0."""
    head, (left, right) = node.head, node.parts
    if left.head == "number" or (right.head != "number" and repr(left) > repr(right)):
        head, left, right = _MIRRORED[head], right, left
    if right.head == "number":
        return left, head, right.value
    return left - right, head, 0.0


def _holds(condition: Formula, x: float) -> bool:
    """Whether a condition holds where the subject of its comparisons is x."""

    def put(node: Formula) -> Formula | None:
        if node.head not in _MIRRORED:
            return None
        _, head, level = _normal(node)
        return TRUE if value_of(compared(head, number(x), number(level)), {}) else FALSE

    try:
        return bool(value_of(substituted(condition, put), {}))
    except NotConstantError:
        return False
