"""Traversal of expressions without recursion, so that no text can exhaust the stack.

A long sum `a + b + c + …` is a left-leaning tree as deep as it is long. `operands` shows such a chain as one node with
many operands, so that its depth is the visible nesting of the expression.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar, assert_never

from gbspec.syntax import ast, ungrouped

T = TypeVar("T")

ADDITIVE = frozenset("+-")
MULTIPLICATIVE = frozenset("*/")


def chain(node: ast.Binary) -> list[tuple[bool, ast.Expression]]:
    """Operands of a sum or of a product, from left to right; True marks those subtracted or divided by."""
    family = ADDITIVE if node.operator in ADDITIVE else MULTIPLICATIVE
    parts: list[tuple[bool, ast.Expression]] = []
    current: ast.Expression = node
    while isinstance(current, ast.Binary) and current.operator in family:
        parts.append((current.operator in "-/", current.right))
        current = ungrouped(current.left)
    parts.append((False, current))
    parts.reverse()
    return parts


def operands(node: ast.Expression) -> tuple[ast.Expression, ...]:
    """The operands of an expression, chains of `+ -` and of `* /` flattened; empty for numbers and names."""
    if isinstance(node, ast.Binary) and node.operator != "^":
        return tuple(part for _, part in chain(node))
    return written_operands(node)


def written_operands(node: ast.Expression) -> tuple[ast.Expression, ...]:
    """The operands of an expression in the tree as it was read, with two for each `+ - * /`."""
    match node:
        case ast.Number() | ast.Name() | ast.RateOf():
            return ()
        case ast.Call(arguments=arguments):
            return arguments
        case ast.Index(index=index):
            return (index,)
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
        case ast.Group(inner=inner) | ast.Conversion(value=inner):
            return (inner,)
        case _:
            assert_never(node)


def walk(root: ast.Expression) -> Iterator[ast.Expression]:
    """Every node, an expression before its operands, in the order of the text."""
    stack = [root]
    while stack:
        node = stack.pop()
        yield node
        stack.extend(reversed(operands(node)))


def fold(
    root: ast.Expression,
    combine: Callable[[ast.Expression, list[T]], T],
    parts: Callable[[ast.Expression], tuple[ast.Expression, ...]] = operands,
) -> T:
    """Computes a value for the root from the values of its operands, bottom up."""
    results: list[T] = []
    stack: list[tuple[ast.Expression, int]] = [(root, -1)]
    while stack:
        node, count = stack.pop()
        if count < 0:
            below = parts(node)
            stack.append((node, len(below)))
            stack.extend((part, -1) for part in reversed(below))
        else:
            split = len(results) - count
            values = results[split:]
            del results[split:]
            results.append(combine(node, values))
    return results[0]
