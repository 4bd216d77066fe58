"""At which derivative in time the outputs first depend on each constant, by the structure of the equations.

A constant far from the outputs, or behind states that start at zero, shows in late derivatives only: until then the
expansion says of it what it says of a constant that nothing depends on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Expr
from gbspec.passes.identifiability.question import Question

NEVER = np.inf


class Reach:
    """The lowest powers of time in the series of expressions, and of their derivatives by the sought constants.

    Terms that cancel, and functions of zero that are not zero for its own sake, are not looked at: the true powers may
    be higher, never lower.
    """

    def __init__(self, question: Question) -> None:
        self._question = question
        self._none = np.full(len(question.sought), NEVER)
        self._arguments = {a.value: a.arguments for a in question.applications}
        self._symbols: dict[sympy.Symbol, tuple[float, Array]] = {}
        for k, learnable in enumerate(question.sought):
            own = self._none.copy()
            own[k] = 0.0
            self._symbols[learnable.symbol] = (0.0, own)
        time = question.model.time
        self._symbols[time.symbol] = (1.0 if time.start == 0 else 0.0, self._none)
        self._memo: dict[Expr, tuple[float, Array]] = {}

    def orders(self) -> Array:
        """For each sought constant the first derivative of a measured quantity that depends on it; inf if none does."""
        states = [s.symbol for s in self._question.model.states]
        self._symbols.update(zip(states, self._starts(), strict=True))
        for _ in range(2 * len(states) + 2):
            before = [self._symbols[s] for s in states]
            self._memo = {}
            for symbol, rate, (power, by) in zip(states, self._question.rates, before, strict=True):
                here, slope = self._of(rate)
                self._symbols[symbol] = min(power, here + 1), np.minimum(by, slope + 1)
            after = [self._symbols[s] for s in states]
            if all(a[0] == b[0] and np.array_equal(a[1], b[1]) for a, b in zip(before, after, strict=True)):
                break
        self._memo = {}
        measured = [states[i] for i in self._question.known]
        return np.asarray(np.min([self._none, *(self._of(e)[1] for e in (*measured, *self._question.outputs))], axis=0))

    def _starts(self) -> list[tuple[float, Array]]:
        dosed = {dose.state for dose in self._question.doses}
        found = []
        for i, start in enumerate(self._question.starts):
            power, by = (0.0, self._none) if start is None else self._of(start)
            found.append((0.0 if i in dosed else power, by))
        for dose in self._question.doses:
            power, by = found[dose.state]
            parts = [self._of(e)[1] for e in (dose.fraction, dose.lag)]
            found[dose.state] = power, np.min([by, *parts], axis=0)
        return found

    def _of(self, e: Expr) -> tuple[float, Array]:
        if e not in self._memo:
            self._memo[e] = self._evaluate(e)
        return self._memo[e]

    def _evaluate(self, e: Expr) -> tuple[float, Array]:
        if e.is_number:
            return (NEVER if e.is_zero else 0.0), self._none
        if e.is_Symbol:
            arguments = self._arguments.get(e)
            return self._symbols.get(e, (0.0, self._none)) if arguments is None else (0.0, self._least(arguments)[1])
        if e.is_Mul:
            return self._product([self._of(part) for part in e.args])
        if e.is_Pow and e.exp.is_number and e.exp > 0:
            power, by = self._of(e.base)
            beside = power * float(e.exp - 1) if e.exp > 1 else 0.0
            return power * float(e.exp), by + beside
        if isinstance(e, sympy.Piecewise):
            return self._least([value for value, _ in e.args])
        power, by = self._least(e.args)
        vanishes = e.is_Add or isinstance(e, sympy.Min | sympy.Max) or (len(e.args) == 1 and e.func(0) == 0)
        return (power if vanishes else 0.0), by

    def _product(self, parts: Sequence[tuple[float, Array]]) -> tuple[float, Array]:
        total, by = 0.0, self._none
        for power, slope in parts:
            by = np.minimum(by + power, slope + total)
            total += power
        return total, by

    def _least(self, parts: Sequence[Expr]) -> tuple[float, Array]:
        found = [self._of(part) for part in parts]
        return min((f[0] for f in found), default=0.0), np.min([self._none, *(f[1] for f in found)], axis=0)
