"""Short forms of statements about arrays: one expression for all elements, and `sum(c)` unexpanded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache

import sympy

from gbspec.ir import Element, Expr, Family, StateArray, Total, Vector, symbol
from gbspec.lower.expressions import is_finite
from gbspec.semantics import Checked, running_index, walk
from gbspec.syntax import ast, target_name

Build = Callable[[ast.Expression, Mapping[str, Expr]], Expr]


class NotShort(Exception):  # noqa: N818 - not an error: the statement stays expanded
    """A statement that has no short form, such as one with an index that is not linear."""


class ShortForms:
    """Reads the statements of a checked model that are about arrays; `build` translates their expressions."""

    def __init__(self, checked: Checked, build: Build) -> None:
        self._checked, self._build = checked, build
        self._numbers = {symbol(name): _number(value) for name, value in checked.constants.items()}
        self._ends = cache(self._end)

    # ---------------------------------------------------------------- elements
    def indexing(self, node: ast.Index, index: Expr) -> Expr:
        """An element of an array: its own symbol or end expression if its index is a number, else an `Element`."""
        name = node.array.text
        place = sympy.expand(index.xreplace(self._numbers))
        running = place.free_symbols
        if not running:
            return self._at(name, _whole(place))
        (loop,) = running if len(running) == 1 else (None,)
        if loop is None or not loop.is_integer or self._checked.arrays[name].row:
            raise NotShort  # a constant for each element stays written out
        step, offset = place.coeff(loop, 1), place.coeff(loop, 0)
        if place != step * loop + offset:
            raise NotShort
        return Element(symbol(name), _whole(step) * loop + _whole(offset))

    def name_of(self, node: ast.Index, index: Expr) -> str:
        """The state's name for an element; raises `NotShort` if it depends on a running index."""
        return self._checked.arrays[node.array.text].element(_whole(sympy.expand(index.xreplace(self._numbers))))

    def total(self, call: ast.Call) -> Expr:
        """`sum(c)`."""
        argument = call.arguments[0]
        if isinstance(argument, ast.Name) and self._checked.arrays[argument.text].row:
            raise NotShort
        return Total(symbol(argument.text)) if isinstance(argument, ast.Name) else sympy.S.Zero

    def _at(self, name: str, index: int) -> Expr:
        array = self._checked.arrays[name]
        return symbol(array.element(index)) if array.first <= index <= array.last else self._ends(name, index)

    def _end(self, name: str, index: int) -> Expr:
        return self._build(self._checked.arrays[name].ends[index].value, {})

    # ---------------------------------------------------------------- parts of the Model
    def arrays(self, states: Mapping[str, int]) -> tuple[StateArray, ...]:
        """The arrays; `states` are the positions of the states by name."""
        found = []
        for name, array in self._checked.arrays.items():
            if array.row:
                continue
            names = array.elements
            ends = tuple((k, self._ends(name, k)) for k in sorted(array.ends))
            found.append(StateArray(name, array.first, names, states[names[0]], ends))
        return tuple(found)

    def families(self, places: Mapping[Vector, Mapping[str, int]]) -> tuple[Family, ...]:
        """The families; `places` are the positions of the entries of each vector by name."""
        return tuple(self._families(places))

    def _families(self, places: Mapping[Vector, Mapping[str, int]]) -> Iterator[Family]:
        for item in self._checked.source:
            try:
                match item.statement:
                    case ast.BalanceStatement(target=target, value=value):
                        yield from self._about("balances", target, value, places)
                    case ast.ObserveStatement(target=target, value=value):
                        yield from self._about("channels", target, value, places)
                    case ast.InitialStatement(target=target, value=ast.Node() as value):
                        yield from self._about("starts", target, value, places)
                    case ast.LetStatement(name=name, value=value) | ast.ProcessStatement(name=name, rate=value):
                        yield from self._single("intermediates", name.text, value, places)
            except NotShort:
                continue

    def _about(
        self,
        vector: Vector,
        target: ast.Name | ast.Index,
        value: ast.Expression | None,
        places: Mapping[Vector, Mapping[str, int]],
    ) -> Iterator[Family]:
        """The families of a statement about a name, an element, or all elements of an array."""
        array = self._checked.arrays.get(target_name(target).text)
        loop = running_index(target, self._checked.constants)
        if array is None or (loop is None and isinstance(target, ast.Index)):
            name = self.name_of(target, self._build(target.index, {})) if isinstance(target, ast.Index) else target.text
            if vector != "starts":
                yield from self._single(vector, name, value, places)
            return
        if array.row:
            raise NotShort
        running = sympy.Symbol(loop or "i", integer=True)
        if value is None:
            expression: Expr = Element(symbol(array.name), running)
        else:
            expression = self._build(value, {loop: running} if loop else {})
        if is_finite(expression) and not (vector == "starts" and expression.has(Element, Total)):
            begin, count = places[vector][array.element(array.first)], array.last - array.first + 1
            yield Family(vector, begin, count, expression, running, array.first, array.name)

    def _single(
        self,
        vector: Vector,
        name: str,
        value: ast.Expression | None,
        places: Mapping[Vector, Mapping[str, int]],
    ) -> Iterator[Family]:
        """The family of a single entry, if it sums an array."""
        if value is not None and self._checked.arrays and _adds_up(value):
            expression = self._build(value, {})
            if is_finite(expression):
                yield Family(vector, places[vector][name], 1, expression)


def _adds_up(value: ast.Expression) -> bool:
    return any(isinstance(node, ast.Call) and node.function.text == "sum" for node in walk(value))


def _number(value: float) -> Expr:
    return sympy.Integer(int(value)) if value == int(value) else sympy.Float(value)


def _whole(value: Expr) -> int:
    if not value.is_number or value != int(value):
        raise NotShort
    return int(value)


def places_of(names: Sequence[str]) -> dict[str, int]:
    """The position of each name."""
    return {name: place for place, name in enumerate(names)}
