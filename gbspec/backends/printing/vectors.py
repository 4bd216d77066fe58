"""Short forms of a model as expressions of whole vectors: one statement per array, whatever its number of elements.

An element `c[i - 1]` with the running index becomes a vector: a part of the state, joined with the values that close
its ends. Parts that do not depend on the index are computed once, as scalars, and enter vector operations as columns of
one component. `Program` then orders and prints these statements like all others.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable

import sympy
from sympy.core.function import AppliedUndef

from gbspec.backends.printing.nodes import (
    STATE,
    Column,
    Entry,
    Indices,
    Join,
    Part,
    Repeat,
    Sum,
    VectorTemporary,
    is_vector,
    temporary,
)
from gbspec.backends.printing.statements import Assignment, rebuild
from gbspec.ir import Element, Expr, Family, Model, StateArray, Total


class Vectors:
    """Turns a model's short forms into expressions of vectors; `definitions` holds the assignments that these need."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._arrays = {array.symbol: array for array in model.arrays}
        self._known: dict[Hashable, sympy.Symbol] = {}
        self.definitions: list[Assignment] = []
        for run in model.runs("intermediates") if model.arrays else range(len(model.intermediates)):
            item = model.intermediates[run if isinstance(run, int) else run.begin]
            value = item.value if isinstance(run, int) else self.value(run)
            self.definitions.append(Assignment(item.symbol, value, item.name))

    def value(self, family: Family) -> Expr:
        """The expression of a family: a vector of `count` components, or a scalar if it has no running index."""
        if family.index is None:
            return self._without_totals(family.value)
        if not family.value.has(Element, family.index):
            return Repeat(STATE, self._without_totals(family.value), family.count)
        elements = sorted(family.value.atoms(Element), key=sympy.default_sort_key)
        table: dict[sympy.Basic, Expr] = {element: self._window(element, family) for element in elements}
        if family.value.has(family.index):
            table[family.index] = self._indices(family)
        return self._columns(self._without_totals(family.value.xreplace(table)))

    def entries(self, outputs: Iterable[Assignment], given: Iterable[Assignment] = ()) -> list[Assignment]:
        """Definitions of the states that these outputs and all definitions use, as components of the state vector.

        States that `given` defines are omitted.
        """
        used = {symbol for item in (*outputs, *self.definitions) for symbol in item.value.free_symbols}
        used -= {item.symbol for item in given}
        return [
            Assignment(state.symbol, Entry(STATE, place), state.name)
            for place, state in enumerate(self._model.states)
            if state.symbol in used
        ]

    # ---------------------------------------------------------------- arrays
    def whole(self, array: StateArray) -> sympy.Symbol:
        """An array as a vector."""
        everything = array.count == len(self._model.states)
        value = STATE if everything else Part(STATE, array.position, array.position + array.count)
        return self._define(array.symbol, value, array.name)

    def _without_totals(self, value: Expr) -> Expr:
        totals = sorted(value.atoms(Total), key=sympy.default_sort_key)
        return value.xreplace({total: Sum(self.whole(self._arrays[total.args[0]])) for total in totals})

    def _window(self, element: Element, family: Family) -> sympy.Symbol:
        """The vector of an element over the running index."""
        array, place = self._arrays[element.args[0]], element.args[1]
        step, first = int(place.coeff(family.index, 1)), int(place.subs(family.index, family.first))
        indices = range(first, first + step * family.count, step)
        if indices == range(array.first, array.last + 1):
            return self.whole(array)
        inside = [k for k in indices if array.first <= k <= array.last]
        before = list(indices[: indices.index(inside[0])]) if inside else list(indices)
        after = list(indices[indices.index(inside[-1]) + 1 :]) if inside else []
        parts: list[Expr] = [self._end(array, k) for k in before]
        if inside:
            begin = array.position + inside[0] - array.first
            parts.append(Part(STATE, begin, begin + step * len(inside), *([step] if step != 1 else [])))
        parts += [self._end(array, k) for k in after]
        shift = first - array.first
        wish = f"{array.name}_{'m' if shift < 0 else 'p'}{abs(shift)}" if step == 1 else f"{array.name}_part"
        return self._define((array, indices), parts[0] if len(inside) == len(indices) else Join(STATE, *parts), wish)

    def _end(self, array: StateArray, index: int) -> Expr:
        value = self._without_totals(array.at(index))
        if not value.is_Atom:
            wish = f"{array.name}_at_{'m' if index < 0 else ''}{abs(index)}"
            if value not in self._known:
                self._known[value] = temporary(wish)
                self.definitions.append(Assignment(self._known[value], value, wish))
            value = self._known[value]
        return value if value.is_number else self._column(value)

    def _indices(self, family: Family) -> sympy.Symbol:
        value = Indices(STATE, family.first, family.first + family.count)
        return self._define(value, value, str(family.index))

    def _define(self, key: Hashable, value: Expr, wish: str) -> sympy.Symbol:
        if key not in self._known:
            self._known[key] = VectorTemporary(wish, real=True)
            self.definitions.append(Assignment(self._known[key], value, wish))
        return self._known[key]

    # ---------------------------------------------------------------- scalars among vectors
    def _columns(self, node: Expr, whole: bool = True) -> Expr:
        """The expression with its largest scalar parts as columns; within choices (`whole` False) only its names.

        A part of a branch that is not taken may be undefined, so it is not computed outside the choice.
        """
        if _is_number(node) or isinstance(node, VectorTemporary):
            return node
        scalar = isinstance(node, sympy.Expr) and not is_vector(node)
        if scalar and (whole or not node.args or isinstance(node, Sum | AppliedUndef)):
            return self._column(node)
        whole = whole and not isinstance(node, sympy.Piecewise)
        parts = list(node.args)
        if whole and isinstance(node, sympy.Add | sympy.Mul):
            alike = [a for a in parts if not _is_number(a) and not is_vector(a)]
            if len(alike) > 1:
                parts = [a for a in parts if a not in alike] + [node.func(*alike)]
        return rebuild(node, [self._columns(part, whole) for part in parts])

    def _column(self, value: Expr) -> sympy.Symbol:
        return self._define(Column(value), Column(value), f"{value}_" if value.is_Symbol else "factor")


def _is_number(node: sympy.Basic) -> bool:
    return not node.free_symbols and not node.has(AppliedUndef)
