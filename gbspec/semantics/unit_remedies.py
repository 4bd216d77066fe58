"""What to write where units disagree, in the language: each text that is proposed can be put where it is said."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fractions import Fraction

from gbspec.diagnostics import Span
from gbspec.semantics.conversions import written_number
from gbspec.semantics.unification import Solution, factor_between
from gbspec.semantics.units import ONE, Unit
from gbspec.syntax import ast, ungrouped

KELVIN = Unit((("K", Fraction(1)),))
_OFFSET = frozenset({"degC", "degF", "celsius", "fahrenheit", "degree_Celsius", "degree_Fahrenheit"})


def remedy(solution: Solution, wanted: Unit, unit: Unit, what: ast.Expression | Span, convertible: bool = True) -> str:
    """The help for what is in one unit and is wanted in another; a span is no expression that can be converted."""
    wanted, unit = solution.resolved(wanted), solution.resolved(unit)
    if wanted.unknowns or unit.unknowns:
        return ""
    ratio = wanted.times(unit, Fraction(-1))
    factor = factor_between(unit, wanted, solution.namespace)
    if factor is None and isinstance(what, ast.Expression) and convertible and solution.namespace.moved(unit, wanted):
        return f"scales of temperature have different zeros; to convert it write `{_in(what, wanted)}`"
    if factor is None and any(name in _OFFSET for name, _ in ratio.names):
        return "scales of temperature with different zeros do not convert by a factor; use one of them throughout"
    if factor is None:
        return f"a factor with the unit `{ratio}` is missing, or there is a superfluous one"
    if isinstance(what, ast.Expression) and convertible:
        return f"convert it: `{_in(what, wanted)}`, a factor of {factor:.12g}"
    text = excerpt(what) if isinstance(what, ast.Expression) else " ".join(what.text.split())
    return f"multiply `{text}` by a constant that converts: `const per : {ratio} = {factor:.12g}`"


def made_pure(solution: Solution, node: ast.Expression, unit: Unit, convertible: bool) -> str:
    """The help for what should be a pure number; one in mixed units, such as `kJ/J`, is converted to it."""
    if solution.known(unit) is not None and factor_between(solution.resolved(unit), ONE, solution.namespace):
        return remedy(solution, ONE, unit, node, convertible)
    return f"divide it by a constant of the unit `{solution.shown(unit)}`"


def made_absolute(solution: Solution, unit: Unit, named: Iterable[tuple[str, Unit]]) -> str:
    """The help for what would be a pure number if one of the temperatures that are `named` in it, in a scale with a
    zero of its own (`degC`), were absolute; empty where that is not so."""
    namespace = solution.namespace
    for name, own in named:
        scale = solution.known(own)
        if scale is None or not namespace.is_scale(scale.lone()):
            continue
        for power in (-1, 1):
            product = unit.times(KELVIN.times(scale, Fraction(-1)), Fraction(power))
            if solution.known(product) is not None and factor_between(solution.resolved(product), ONE, namespace):
                return f"`{name}` is in `{scale}`, whose zero is not that of `K`: write `({name} in K)` for it"
    return ""


def of_bare_number(
    solution: Solution, first: ast.Expression, one: Unit, second: ast.Expression, other: Unit, added: bool
) -> str:
    """The help where a bare number is added to, or compared with, what has a unit: it may be in that unit.

    A summand 1 is one of `1 - X/K`, where the unit of K is what is missing.
    """
    for node, mine, others in ((second, other, one), (first, one, other)):
        unit, text = solution.known(others), excerpt(node)
        if solution.known(mine) != ONE or unit in (None, ONE) or not written_number(node):
            continue
        if not added or text.lstrip("+-") not in ("1", "1.0"):
            return f"give the number its unit: `({text} in {unit})`, or by a name: `const NAME : {unit} = {text}`"
    return ""


def excerpt(node: ast.Expression) -> str:
    """An expression in a message, if it is long its beginning."""
    text = _without_comments(ungrouped(node))
    return text if len(text) <= 30 else text[:27] + "..."


def _without_comments(node: ast.Expression) -> str:
    """The text of an expression in one line."""
    return " ".join(re.sub(r"#[^\n]*", "", node.span.text).split())


def _in(node: ast.Expression, unit: Unit) -> str:
    """How an expression is written in another unit: all of it, and a conversion within it in its own parentheses."""
    inner = ungrouped(node)
    text = _without_comments(inner)
    return f"(({text}) in {unit})" if isinstance(inner, ast.Conversion) else f"({text} in {unit})"
