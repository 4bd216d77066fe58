"""Expressions rewritten without recursion, so that no text can exhaust the stack."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from gbspec.syntax import ast


def rebuilt(
    root: ast.Expression,
    put: Callable[[ast.Expression], ast.Expression],
    wanted: Callable[[ast.Expression], bool],
) -> ast.Expression:
    """The expression with `put` applied to its outermost parts that are `wanted`; unchanged parts are shared."""
    results: list[ast.Expression] = []
    stack: list[tuple[ast.Expression, int]] = [(root, -1)]
    while stack:
        node, count = stack.pop()
        if count < 0 and wanted(node):
            results.append(put(node))
        elif count < 0:
            below = _operands(node)
            stack.append((node, len(below)))
            stack.extend((part, -1) for part in reversed(below))
        else:
            split = len(results) - count
            parts = results[split:]
            del results[split:]
            same = all(new is old for new, old in zip(parts, _operands(node), strict=True))
            results.append(node if same else _with_operands(node, parts))
    return results[0]


def _operands(node: ast.Expression) -> tuple[ast.Expression, ...]:
    match node:
        case ast.Call(arguments=arguments):
            return arguments
        case ast.Unary(operand=operand):
            return (operand,)
        case (
            ast.Binary(left=left, right=right)
            | ast.Comparison(left=left, right=right)
            | ast.Logic(left=left, right=right)
        ):
            return left, right
        case ast.Conditional(condition=condition, then=then, otherwise=otherwise):
            return condition, then, otherwise
        case ast.Group(inner=inner):
            return (inner,)
        case _:
            return ()


def _with_operands(node: ast.Expression, parts: list[ast.Expression]) -> ast.Expression:
    match node:
        case ast.Call():
            return dataclasses.replace(node, arguments=tuple(parts))
        case ast.Unary():
            return dataclasses.replace(node, operand=parts[0])
        case ast.Binary() | ast.Comparison() | ast.Logic():
            return dataclasses.replace(node, left=parts[0], right=parts[1])
        case ast.Conditional():
            return dataclasses.replace(node, condition=parts[0], then=parts[1], otherwise=parts[2])
        case ast.Group():
            return dataclasses.replace(node, inner=parts[0])
        case _:
            return node
