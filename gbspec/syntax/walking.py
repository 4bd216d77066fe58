"""Traversal of syntax trees without recursion: a sum of 5,000 terms is a tree 5,000 deep to the left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import TypeVar

from gbspec.syntax import nodes as ast

Result = TypeVar("Result")


_FIELDS: dict[type, tuple[str, ...]] = {}


def _field_names(node: ast.Node) -> tuple[str, ...]:
    kind = type(node)
    if kind not in _FIELDS:
        _FIELDS[kind] = tuple(f.name for f in fields(node) if f.name != "span")
    return _FIELDS[kind]


def children(node: ast.Node) -> tuple[ast.Node, ...]:
    """The nodes directly below, in the order of the fields."""
    found: list[ast.Node] = []
    for name in _field_names(node):
        value = getattr(node, name)
        if isinstance(value, ast.Node):
            found.append(value)
        elif isinstance(value, tuple):
            found.extend(v for v in value if isinstance(v, ast.Node))
    return tuple(found)


def walk(node: ast.Node) -> Iterator[ast.Node]:
    """The node and all below it, parents before children, from left to right."""
    stack = [node]
    while stack:
        current = stack.pop()
        yield current
        stack.extend(reversed(children(current)))


def fold(node: ast.Node, rule: Callable[[ast.Node, tuple[Result, ...]], Result]) -> Result:
    """Computes a result bottom up: `rule(node, results of its children)`, without recursion.

    The children's results come in the order of `children(node)`.
    """
    results: list[Result] = []
    stack: list[tuple[ast.Node, int]] = [(node, -1)]
    while stack:
        current, count = stack.pop()
        if count < 0:
            below = children(current)
            stack.append((current, len(below)))
            stack.extend((child, -1) for child in reversed(below))
        else:
            cut = len(results) - count
            arguments = tuple(results[cut:])
            del results[cut:]
            results.append(rule(current, arguments))
    return results[0]


def same(first: ast.Node | None, second: ast.Node | None) -> bool:
    """Whether two trees are equal apart from places in the text."""
    stack: list[tuple[object, object]] = [(first, second)]
    while stack:
        a, b = stack.pop()
        if isinstance(a, ast.Node):
            if type(a) is not type(b):
                return False
            stack.extend((getattr(a, name), getattr(b, name)) for name in _field_names(a))
        elif isinstance(a, tuple):
            if not isinstance(b, tuple) or len(a) != len(b):
                return False
            stack.extend(zip(a, b, strict=True))
        elif a != b:
            return False
    return True


def ungrouped(expression: ast.Expression) -> ast.Expression:
    """The expression inside its parentheses."""
    while isinstance(expression, ast.Group):
        expression = expression.inner
    return expression
