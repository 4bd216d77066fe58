"""Which quantities a model declares never to be negative."""

from __future__ import annotations

from gbspec.ir import Expr, Model
from gbspec.passes.intervals import Interval, enclosure, of_range


def never_negative(model: Model, value: Expr) -> bool:
    """Whether an expression is not negative as long as states, inputs, conditions and constants are in their declared
    ranges. Unknown functions may be anything here."""
    box = {c.symbol: Interval(c.value, c.value) for c in model.constants}
    box |= {k.symbol: of_range(k.individual.range) for k in model.learnables}
    box |= {state.symbol: of_range(state.range) for state in model.states}
    box |= {given.symbol: of_range(given.range) for given in model.inputs}
    box |= {condition.symbol: of_range(condition.range) for condition in model.conditions}
    found = enclosure(value, box)
    return found is not None and found.nonnegative
