"""Quantities given in a unit: `3.2 in mH`, `(I*R in V)`, `T in K`; once units are checked, they are plain arithmetic.

A number is in the unit that follows it; at a place that takes a number in its own unit (a constant that declares one,
a start, a time of an event) it is converted to that. The value of any other expression is multiplied by the factor
between both units; between scales of temperature a summand is added too, unless it is a difference.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from gbspec.diagnostics import Findings
from gbspec.semantics.expressions import walk
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.rewriting import converts, rebuilt, with_expressions
from gbspec.semantics.unification import factor_between
from gbspec.semantics.units import Namespace, Unit
from gbspec.syntax import Place, ast, ungrouped

Key = tuple[str, int, int]


@dataclass(frozen=True)
class Scale:
    """What a value is multiplied by, and what is then added."""

    factor: float = 1.0
    summand: float = 0.0


@dataclass
class Conversions:
    """The scale of each conversion of a model, by its place in the text; None where an error was reported."""

    found: dict[Key, Scale | None] = field(default_factory=dict)

    def note(self, node: ast.Conversion, scale: Scale | None) -> bool:
        """Keeps a scale; False if the same text would need another one elsewhere."""
        known = self.found.setdefault(_key(node), scale)
        return known is None or scale is None or math.isclose(known.factor, scale.factor, rel_tol=1e-12)

    def excuse(self, expression: ast.Expression) -> None:
        """Leaves the conversions of an expression that has an error as they are."""
        for node in walk(expression):
            if isinstance(node, ast.Conversion):
                self.found.setdefault(_key(node), None)

    def put(self, node: ast.Conversion, scale: Scale) -> None:
        """Replaces the scale of a number by that to the unit of its place."""
        self.found[_key(node)] = scale


def between(found: Unit, wanted: Unit, namespace: Namespace) -> Scale | None:
    """The scale by which a value in one unit becomes one in the other; None if they are of different kinds."""
    found = namespace.in_products(found)
    factor = factor_between(found, wanted, namespace)
    if factor is not None:
        return Scale(factor)
    moved = namespace.moved(found, wanted)
    return None if moved is None else Scale(*moved)


def written_number(node: ast.Expression) -> bool:
    """Whether an expression is a number as it is written, perhaps with a sign."""
    node = ungrouped(node)
    while isinstance(node, ast.Unary) and node.operator != "not":
        node = ungrouped(node.operand)
    return isinstance(node, ast.Number)


def conversion_of(node: ast.Expression) -> ast.Conversion | None:
    """The conversion that an expression is, but for parentheses."""
    inner = ungrouped(node)
    return inner if isinstance(inner, ast.Conversion) else None


def occur(items: Iterable[Item]) -> bool:
    """Whether a model gives any quantity in a unit."""
    return any(converts(item.statement) for item in items)


def applied(read: Merged, conversions: Conversions, findings: Findings) -> Merged:
    """The statements with each conversion written out; one whose place offers none is an error (GB789)."""

    def put(node: ast.Expression) -> ast.Expression:
        assert isinstance(node, ast.Conversion)
        value = rebuilt(node.value, put, _is_conversion)
        if _key(node) not in conversions.found:
            _refuse(node, findings)
        return _scaled(node, value, conversions.found.get(_key(node)) or Scale())

    def written_out(place: Place) -> ast.Expression:
        return rebuilt(place.expression, put, _is_conversion)

    items = tuple(
        dataclasses.replace(item, statement=with_expressions(item.statement, written_out))
        if converts(item.statement)
        else item
        for item in read.items
    )
    return dataclasses.replace(read, items=items)


def _is_conversion(node: ast.Expression) -> bool:
    return isinstance(node, ast.Conversion)


def _key(node: ast.Node) -> Key:
    return node.span.source.path, node.span.start, node.span.end


def _refuse(node: ast.Conversion, findings: Findings) -> None:
    findings.error(
        "GB789",
        "a quantity cannot be given in a unit here",
        node.span,
        help="write the number in the declared unit, or declare a constant: `const L : H = 3.2 in mH`",
    )


def _scaled(node: ast.Conversion, value: ast.Expression, scale: Scale) -> ast.Expression:
    """The value times the factor (or divided by its inverse, if that is the rounder number), plus the summand."""
    span, factor = node.span, scale.factor
    result: ast.Expression = value if not isinstance(value, ast.Binary) else ast.Group(span, value)
    inverse = 1 / factor
    if factor != 1:
        if abs(inverse) > 1 and math.isclose(inverse, round(inverse), rel_tol=1e-14):
            result = ast.Binary(span, "/", result, ast.Number(span, repr(float(round(inverse)))))
        else:
            result = ast.Binary(span, "*", result, ast.Number(span, repr(factor)))
    if scale.summand:
        sign = "+" if scale.summand > 0 else "-"
        result = ast.Binary(span, sign, result, ast.Number(span, repr(abs(scale.summand))))  # type: ignore[arg-type]
    return ast.Group(span, result)
