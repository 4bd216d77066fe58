"""Rewrites expressions without recursion, so that no text can exhaust the stack."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import assert_never, cast

from gbspec.semantics.expressions import written_operands
from gbspec.syntax import Place, ast, walk

_IN_A_UNIT = re.compile(r"\bin\b(?!\s*\[)")


def converts(statement: ast.Statement) -> bool:
    """Whether a statement gives a quantity in a unit."""
    # The text is looked at first, since a tree may have many thousand nodes.
    return _IN_A_UNIT.search(statement.span.text) is not None and any(
        isinstance(part, ast.Conversion) for part in walk(statement)
    )


def rebuilt(
    root: ast.Expression,
    put: Callable[[ast.Expression], ast.Expression],
    wanted: Callable[[ast.Expression], bool],
) -> ast.Expression:
    """The expression with `put` applied to the outermost sub-expressions that are `wanted`; the rest is shared."""
    results: list[ast.Expression] = []
    stack: list[tuple[ast.Expression, int]] = [(root, -1)]
    while stack:
        node, count = stack.pop()
        if count < 0 and wanted(node):
            results.append(put(node))
        elif count < 0:
            below = written_operands(node)
            stack.append((node, len(below)))
            stack.extend((part, -1) for part in reversed(below))
        else:
            split = len(results) - count
            parts = results[split:]
            del results[split:]
            same = all(new is old for new, old in zip(parts, written_operands(node), strict=True))
            results.append(node if same else _with_operands(node, parts))
    return results[0]


def with_expressions(statement: ast.Statement, change: Callable[[Place], ast.Expression]) -> ast.Statement:
    """The statement with `change` applied to each of its expressions; unchanged parts are shared."""
    changed = {id(place.expression): change(place) for place in statement.places()}

    def put(part: object) -> object:
        if id(part) in changed:
            return changed[id(part)]
        if isinstance(part, tuple):
            parts = tuple(put(inner) for inner in part)
            return part if all(new is old for new, old in zip(parts, part, strict=True)) else parts
        if not isinstance(part, ast.Node) or isinstance(part, ast.Expression):
            return part
        new = {f.name: put(old) for f in dataclasses.fields(part) if (old := getattr(part, f.name)) is not part.span}
        new = {name: value for name, value in new.items() if value is not getattr(part, name)}
        return dataclasses.replace(part, **new) if new else part  # type: ignore[arg-type]  # fields by name

    return cast(ast.Statement, put(statement))


def _with_operands(node: ast.Expression, parts: list[ast.Expression]) -> ast.Expression:
    match node:
        case ast.Number() | ast.Name() | ast.RateOf():
            return node
        case ast.Call():
            return dataclasses.replace(node, arguments=tuple(parts))
        case ast.Index():
            return dataclasses.replace(node, index=parts[0])
        case ast.Unary():
            return dataclasses.replace(node, operand=parts[0])
        case ast.Binary() | ast.Comparison() | ast.Logic():
            return dataclasses.replace(node, left=parts[0], right=parts[1])
        case ast.Conditional():
            return dataclasses.replace(node, condition=parts[0], then=parts[1], otherwise=parts[2])
        case ast.Group():
            return dataclasses.replace(node, inner=parts[0])
        case ast.Conversion():
            return dataclasses.replace(node, value=parts[0])
        case _:
            assert_never(node)
