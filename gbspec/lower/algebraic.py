"""Algebraic variables and equations of a checked model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gbspec.ir import Algebraic, Equation, Expr, Model, Range
from gbspec.lower.small import string, unit_text
from gbspec.semantics import Checked
from gbspec.syntax import ast, target_name

Lower = Callable[[ast.Expression], Expr]


def lowered(model: Model, checked: Checked, expression: Lower) -> Model:
    """The model with its algebraic variables and its equations, in the order of the text."""
    return replace(
        model,
        algebraics=tuple(_variable(s, checked) for s in checked.all(ast.AlgebraicStatement)),
        constraints=tuple(
            Equation(
                target_name(s.target).text,
                left=expression(s.left),
                right=expression(s.right),
                description=string(s.description),
                span=s.span,
            )
            for s in checked.all(ast.EquationStatement)
        ),
    )


def _variable(s: ast.AlgebraicStatement, checked: Checked) -> Algebraic:
    ends = checked.numbers.interval(s.range)
    return Algebraic(
        s.declarator.name.text,
        None if ends is None else Range(*ends),
        checked.numbers.value(s.start),
        unit=unit_text(s.unit),
        description=string(s.description),
        span=s.declarator.name.span,
    )
