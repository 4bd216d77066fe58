"""The value of an expression, computed from its tree; for comparing the parser with Python's own."""

from __future__ import annotations

from collections.abc import Mapping

from gbspec.syntax import ast
from gbspec.syntax.walking import fold

OPERATORS = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "^": lambda a, b: a**b,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "==": lambda a, b: a == b,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
}


def evaluate(expression: ast.Expression, values: Mapping[str, float]) -> float:
    """The value of an expression for given values of its names."""

    def rule(node: ast.Node, below: tuple[float, ...]) -> float:
        match node:
            case ast.Number():
                return node.value
            case ast.Name():
                return values[node.text]
            case ast.Group():
                return below[0]
            case ast.Unary(operator=operator):
                return {"-": -below[0], "+": below[0], "not": not below[0]}[operator]
            case ast.Conditional():
                return below[1] if below[0] else below[2]
            case ast.Binary() | ast.Comparison() | ast.Logic():
                return OPERATORS[node.operator](*below)
        raise TypeError(type(node).__name__)

    return fold(expression, rule)
