"""Values of states that are measured through a formula: `observe pH = -log(h)/log(10)`, `observe T_C = T - 273.15`.

Such a channel shows its state where the formula has one state, once, in parts that have an inverse. The values are for
curves and first guesses alone: residuals are those of the channel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Expr, Model


@dataclass(frozen=True)
class Step:
    """One function of the state in a formula, from outside: what it is, and its other operand."""

    kind: Literal["sum", "product", "log", "exp", "power"]
    other: Expr

    def undone(self, values: Array, other: float) -> Array:
        """What the function was applied to."""
        match self.kind:
            case "sum":
                return values - other
            case "product":
                return values / other
            case "log":
                return np.asarray(np.exp(values))
            case "exp":
                return np.asarray(np.log(values))
        return np.asarray(np.sign(values) * np.abs(values) ** (1 / other))


@dataclass(frozen=True)
class Reading:
    """A channel that shows a state, by these steps, of which conditions may be operands."""

    channel: int
    steps: tuple[Step, ...]
    conditions: tuple[sympy.Symbol, ...]
    range: tuple[float, float]

    def values(self, measured: Array, condition: Array) -> Array:
        """The state [R] where the channel has the values `measured` [R], within its declared range; NaN: none."""
        numbers = {symbol: sympy.Float(value) for symbol, value in zip(self.conditions, condition, strict=True)}
        found = np.asarray(measured, dtype=np.float64)
        with np.errstate(all="ignore"):
            for step in self.steps:
                found = step.undone(found, float(step.other.xreplace(numbers)))
        return np.where(np.isfinite(found), np.clip(found, *self.range), np.nan)


def readings(model: Model) -> Mapping[int, Reading]:
    """The states that no channel measures directly, each with the last channel that shows it."""
    direct = {channel.state for channel in model.channels}
    numbers = {constant.symbol: sympy.Float(constant.value) for constant in model.constants}
    conditions = tuple(condition.symbol for condition in model.conditions)
    found: dict[int, Reading] = {}
    for index, formula in enumerate(model.inlined([channel.value for channel in model.channels])):
        shown = [i for i, state in enumerate(model.states) if state.symbol in formula.free_symbols]
        if len(shown) != 1 or shown[0] in direct:
            continue
        state = model.states[shown[0]]
        steps = _steps(formula.xreplace(numbers), state.symbol)
        if steps is None or not all(step.other.free_symbols <= set(conditions) for step in steps):
            continue
        bounds = (-np.inf, np.inf) if state.range is None else (state.range.low, state.range.high)
        found[shown[0]] = Reading(index, steps, conditions, bounds)
    return found


def _steps(formula: Expr, state: sympy.Symbol) -> tuple[Step, ...] | None:
    """The functions of the state, the outermost first; None where it is in several parts, or one has no inverse."""
    if formula == state:
        return ()
    inner = [part for part in formula.args if state in part.free_symbols]
    if len(inner) != 1:
        return None
    (part,), others = inner, [other for other in formula.args if state not in other.free_symbols]
    step: Step | None = None
    if formula.is_Add:
        step = Step("sum", sympy.Add(*others))
    elif formula.is_Mul:
        step = Step("product", sympy.Mul(*others))
    elif isinstance(formula, sympy.log | sympy.exp):
        step = Step("log" if isinstance(formula, sympy.log) else "exp", sympy.S.One)
    elif formula.is_Pow and part is formula.base and formula.exp.is_number and not _even(formula.exp):
        step = Step("power", formula.exp)
    further = None if step is None else _steps(part, state)
    return None if step is None or further is None else (step, *further)


def _even(exponent: Expr) -> bool:
    """Whether a power has two values of its base."""
    return bool(exponent.is_integer) and int(exponent) % 2 == 0
