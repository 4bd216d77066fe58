"""The rules of expressions and units."""

# ruff: noqa: D102 - each method is named after the rule of gb.lark whose node it builds

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, cast

from gbspec.syntax import nodes as ast
from gbspec.syntax.transformer.parts import Children, Parts, nodes


class ExpressionRules(Parts):
    """The rules of expressions and units."""

    def number(self, children: Children) -> ast.Number:
        (token,) = children
        node = ast.Number(self.place(token), str(token))
        if math.isinf(node.value):
            self.problem(
                "GB150",
                f"`{token}` is larger than any number in double precision (1.8e308)",
                node.span,
                help="choose units in which it is smaller",
            )
        return node

    def quoted(self, children: Children) -> ast.Quoted:
        return ast.Quoted(self.over(children), str(children[0])[1:-1].strip())

    def name(self, children: Children) -> ast.Name:
        (token,) = children
        name = self.name_at(token)
        if name.text in ("if", "and", "or", "not"):
            self.problem("GB136", f"`{name.text}` cannot be used as a name", name.span, help="choose another name")
        return name

    def call(self, children: Children) -> ast.Call:
        arguments = nodes(children)
        for argument in arguments:
            self.number_value(argument)
        node = ast.Call(self.over(children), self.name_at(children[0]), arguments)
        return cast(ast.Call, self.nested(node, arguments))

    def index(self, children: Children) -> ast.Index:
        return self.element(children)

    def rate_of(self, children: Children) -> ast.RateOf:
        *target, _ = children
        inner = self.name(target) if len(target) == 1 else self.element(target)
        return cast(ast.RateOf, self.nested(ast.RateOf(self.over(children), inner), (inner,)))

    def element(self, children: Children) -> ast.Index:
        array, _, index, _ = children
        node = ast.Index(self.over(children), self.name_at(array), self.number_value(index))
        return cast(ast.Index, self.nested(node, (index,)))

    def unary(self, children: Children) -> ast.Unary:
        operator, operand = children
        self.condition_value(operand) if operator == "not" else self.number_value(operand)
        node = ast.Unary(self.over(children), cast(Literal["-", "+", "not"], str(operator)), operand)
        return cast(ast.Unary, self.nested(node, (operand,)))

    def binary(self, children: Children) -> ast.Binary:
        left, token, right = children
        self.number_value(left)
        self.number_value(right)
        operator = cast(Literal["+", "-", "*", "/", "^"], "^" if token == "**" else str(token))
        node = ast.Binary(self.over(children), operator, left, right)
        if operator == "^":
            return cast(ast.Binary, self.nested(node, (left, right)))
        return cast(ast.Binary, self.nested(node, (right,), chain=left))

    def compare(self, children: Children) -> ast.Comparison:
        left, token, right = children
        operator = cast(Literal["<", "<=", ">", ">=", "=="], {"≤": "<=", "≥": ">="}.get(token, str(token)))
        node = ast.Comparison(self.over(children), operator, self.number_value(left), self.number_value(right))
        return cast(ast.Comparison, self.nested(node, (left, right)))

    def logic(self, children: Children) -> ast.Logic:
        left, token, right = children
        self.condition_value(left)
        self.condition_value(right)
        node = ast.Logic(self.over(children), cast(Literal["and", "or"], str(token)), left, right)
        return cast(ast.Logic, self.nested(node, (right,), chain=left))

    def conditional(self, children: Children) -> ast.Conditional:
        condition, then, otherwise = nodes(children)
        self.condition_value(condition)
        self.number_value(then)
        self.number_value(otherwise)
        node = ast.Conditional(self.over(children), condition, then, otherwise)
        return cast(ast.Conditional, self.nested(node, (condition, then, otherwise)))

    def group(self, children: Children) -> ast.Group:
        node = ast.Group(self.over(children), children[1])
        return cast(ast.Group, self.nested(node, (children[1],)))

    def conversion(self, children: Children) -> ast.Conversion:
        value, _, unit = children
        node = ast.Conversion(self.over(children), self.number_value(value), unit)
        return cast(ast.Conversion, self.nested(node, (value,)))

    def unit_name(self, children: Children) -> ast.UnitName:
        if children[0].type == "PERCENT":  # the sign of a unit, known by its name everywhere else
            return ast.UnitName(self.over(children), "percent")
        name = self.name_at(children[0])
        return ast.UnitName(name.span, name.text)

    def unit_number(self, children: Children) -> ast.UnitNumber:
        return ast.UnitNumber(self.over(children), str(children[0]))

    def exponent(self, children: Children) -> ast.UnitNumber:
        text = "".join(token for token in children if token.type in ("PLUS", "MINUS", "NUMBER"))
        return ast.UnitNumber(self.over(children), text.removeprefix("+"))

    def unit_binary(self, children: Children) -> ast.UnitBinary:
        left, token, right = children
        operator = cast(Literal["*", "/", "^"], "^" if token == "**" else str(token))
        return ast.UnitBinary(self.over(children), operator, left, right)

    def unit_group(self, children: Children) -> ast.UnitExpression:
        inner: ast.UnitExpression = children[1]
        return replace(inner, span=self.over(children))
