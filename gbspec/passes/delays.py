"""The shortest and the longest time that bounds allow a delay to be."""

from __future__ import annotations

import math
from collections.abc import Mapping

import sympy

from gbspec.ir import Expr, Model
from gbspec.passes.intervals import Interval, enclosure, of_range


def least_value(model: Model, value: Expr, conditions: Mapping[str, float] | None = None) -> float:
    """The least value of an expression of constants and conditions, by the bounds of these and the given conditions.

    NaN where it may be undefined.
    """
    found = _enclosed(model, value, conditions)
    return math.nan if found is None else found.low


def greatest_value(model: Model, value: Expr, conditions: Mapping[str, float] | None = None) -> float:
    """The greatest value, as `least_value`; it may be infinite."""
    found = _enclosed(model, value, conditions)
    return math.nan if found is None else found.high


def _enclosed(model: Model, value: Expr, conditions: Mapping[str, float] | None) -> Interval | None:
    box = {c.symbol: Interval(c.value, c.value) for c in model.constants}
    box |= {k.symbol: of_range(k.individual.range) for k in model.learnables}
    given = conditions or {}
    for condition in model.conditions:
        known = given.get(condition.name)
        box[condition.symbol] = of_range(condition.range) if known is None else Interval(known, known)
    numbers = {s: sympy.Float(i.low) for s, i in box.items() if i.low == i.high}
    return enclosure(value.xreplace(numbers), box)
