"""The rules of clauses and their parts."""

# ruff: noqa: D102 - each method is named after the rule of gb.lark whose node it builds

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, cast

from lark import Token

from gbspec.diagnostics import Diagnostic, Label
from gbspec.syntax import nodes as ast
from gbspec.syntax.names import normalise
from gbspec.syntax.transformer.expressions import ExpressionRules
from gbspec.syntax.transformer.parts import CLAUSE_WORDS, Children, Clause, Names, nodes, tokens


class ClauseRules(ExpressionRules):
    """The rules of clauses and their parts."""

    def text_clause(self, children: Children) -> Clause:
        return self._string("text", children)

    def extends_clause(self, children: Children) -> Clause:
        return self._string("extends", children)

    def file_clause(self, children: Children) -> Clause:
        path = self._string("file", children).content
        return Clause(self.over(children), "file", ast.PointsFile(self.over(children), path))

    def points_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "points", nodes(children))

    def point(self, children: Children) -> ast.Point:
        return ast.Point(self.over(children), nodes(children))

    def signed_number(self, children: Children) -> ast.Number:
        return ast.Number(self.over(children), "".join(map(str, children)).removeprefix("+"))

    def method_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "method", str(children[0]))

    def outside_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "outside", str(children[-1]))

    def column_clause(self, children: Children) -> Clause:
        return self._string("column", children)

    def _string(self, kind: str, children: Children) -> Clause:
        token = children[-1]
        return Clause(self.over(children), kind, ast.Text(self.place(token), str(token)[1:-1]))

    def _number(self, kind: str, children: Children) -> Clause:
        return Clause(self.over(children), kind, self.number_value(children[-1]))

    def from_clause(self, children: Children) -> Clause:
        return self._number("from", children)

    def value_clause(self, children: Children) -> Clause:
        return self._number("value", children)

    def rate_clause(self, children: Children) -> Clause:
        return self._number("rate", children)

    def over_clause(self, children: Children) -> Clause:
        return self._number("over", children)

    def times_clause(self, children: Children) -> Clause:
        return self._number("times", children)

    def lag_clause(self, children: Children) -> Clause:
        return self._number("lag", children)

    def at_clause(self, children: Children) -> Clause:
        return self._number("at", children)

    def every_clause(self, children: Children) -> Clause:
        return self._number("every", children)

    def until_clause(self, children: Children) -> Clause:
        return self._number("until", children)

    def after_clause(self, children: Children) -> Clause:
        return self._number("after", children)

    def queue_clause(self, children: Children) -> Clause:
        return self._number("queue", children)

    def priority_clause(self, children: Children) -> Clause:
        return self._number("priority", children)

    def when_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "when", self.condition_value(children[-1]))

    def flag_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), str(children[0]), True)

    def assignment(self, children: Children) -> ast.Assignment:
        return ast.Assignment(self.over(children), children[0], self.number_value(children[-1]))

    def assignments_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "assignments", nodes(children))

    def unit_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "unit", children[-1])

    def units_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "unit", nodes(children))

    def range_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "range", children[-1])

    def categories_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "categories", ast.Categories(self.over(children[1:]), nodes(children)))

    def category_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "value", children[-1])

    def interpolation_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "interpolation", str(children[0]))

    def prior_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "prior", children[-1])

    def noise_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "noise", children[-1])

    def per_trajectory_clause(self, children: Children) -> Clause:
        column, spread = children[1], children[-1] if len(children) > 2 else None
        node = ast.Grouping(self.over(children), ast.Text(self.place(column), normalise(str(column))), spread)
        return Clause(self.over(children), "per_trajectory", node)

    def population(self, children: Children) -> ast.Distribution:
        arguments = nodes(children)
        for argument in arguments:
            self.number_value(argument)
        return ast.Distribution(self.over(children), self.name_at(children[0]), arguments)

    def learned_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "learned", None)

    def steady_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "steady", True)

    def with_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "with", nodes(children))

    def then_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "then", nodes(children))

    def postulates_clause(self, children: Children) -> Clause:
        values = nodes(children)
        for value in values:
            self.number_value(value)
        return Clause(self.over(children), "postulates", values)

    def bound(self, children: Children) -> Clause:
        token, value = children
        operator = cast(Literal["<", "<=", ">", ">="], {"≤": "<=", "≥": ">="}.get(token, str(token)))
        node = ast.Bound(self.over(children), operator, self.number_value(value))
        return Clause(node.span, "bound", node)

    def zero_at(self, children: Children) -> Clause:
        node = ast.ZeroAt(self.over(children), self.name_at(children[2]), self.number_value(children[-1]))
        return Clause(node.span, "contract", node)

    def equals_at(self, children: Children) -> Clause:
        _, value, _, argument, _, place = children
        node = ast.EqualsAt(
            self.over(children), self.number_value(value), self.name_at(argument), self.number_value(place)
        )
        return Clause(node.span, "contract", node)

    def shaped(self, children: Children) -> Clause:
        shape = cast(ast.Shape, str(children[0]))
        node = ast.Shaped(self.over(children), shape, self.name_at(children[2]))
        return Clause(node.span, "contract", node)

    def periodic(self, children: Children) -> Clause:
        node = ast.Periodic(self.over(children), self.number_value(children[1]), self.name_at(children[3]))
        return Clause(node.span, "contract", node)

    def contract(self, children: Children) -> ast.Contract:
        clause = children[-1]
        name = self.name_at(children[0]) if isinstance(children[0], Token) else None
        if clause.kind == "range":
            return ast.RangeContract(self.over(children), clause.content, name)
        return cast(ast.Contract, replace(clause.content, span=self.over(children), name=name))

    def contracts_clause(self, children: Children) -> Clause:
        return Clause(self.over(children), "contracts", nodes(children))

    def interval(self, children: Children) -> ast.Interval:
        low, high = nodes(children)
        return ast.Interval(self.over(children), self.number_value(low), self.number_value(high))

    def distribution(self, children: Children) -> ast.Distribution:
        arguments = nodes(children)
        for argument in arguments:
            self.number_value(argument)
        return ast.Distribution(self.over(children), self.name_at(children[0]), arguments)

    measured_noise = distribution

    def option(self, children: Children) -> ast.Option:
        return ast.Option(self.over(children), self.name_at(children[0]), self.number_value(children[-1]))

    def network_clause(self, children: Children) -> Clause:
        items = nodes(children)
        options = tuple(item for item in items if isinstance(item, ast.Option))
        widths = tuple(self.number_value(item) for item in items if not isinstance(item, ast.Option))
        node = ast.NetworkSpec(self.place(children[1], children[-1]), self.name_at(children[1]), widths, options)
        return Clause(self.over(children), "network", node)

    def consumed(self, children: Children) -> Clause:
        return self._number("consumed", children)

    def produced(self, children: Children) -> Clause:
        return self._number("produced", children)

    def left(self, children: Children) -> Clause:
        return self._number("left", children)

    def target(self, children: Children) -> ast.Name | ast.Index:
        (child,) = children
        return self.name_at(child) if isinstance(child, Token) else cast(ast.Index, child)

    def declarator(self, children: Children) -> ast.Declarator:
        name = self.declared(children[0])
        if len(children) == 1:
            return ast.Declarator(name.span, name)
        first, last = (self.number_value(child) for child in nodes(children))
        return ast.Declarator(self.over(children), name, first, last)

    def names(self, children: Children) -> Names:
        return Names(self.over(children), tuple(self.declared(token) for token in tokens(children, "NAME")))

    def parameters(self, children: Children) -> Names:
        inner = nodes(children)
        return Names(self.over(children), inner[0].items if inner else ())

    def arguments(self, children: Children) -> tuple[ast.Argument, ...]:
        return nodes(children)

    def argument(self, children: Children) -> ast.Argument:
        found = self.gather(children, "an argument")
        return ast.Argument(self.over(children), self.declared(children[0]), found.get("unit"), found.get("range"))

    def required(self, children: Children, found: dict[str, Any], kind: str, message: str, help: str) -> Any:
        """The content of a required clause; reports `message` if it is missing."""
        if kind in found:
            return found[kind]
        span = self.over(children)
        self.problem("GB129", message, span, help=help)
        return ast.Number(span, "0")

    def gather(self, children: Children, of: str) -> dict[str, Any]:
        """The clauses that a rule matched, by kind; a repeated clause is reported."""
        clauses = [child for child in children if isinstance(child, Clause)]
        seen: dict[str, Clause] = {}
        bounds: list[ast.Bound] = []
        contracts: list[ast.Contract] = []
        further: list[ast.Grouping] = []
        for clause in clauses:
            kind = clause.kind
            if kind == "per_trajectory" and kind in seen and self._elsewhere(clause, seen[kind], further):
                further.append(clause.content)
                continue
            if kind == "contracts":
                contracts.extend(clause.content)
                continue
            if kind == "bound":
                bounds.append(clause.content)
                kind = "lower" if clause.content.operator in (">", ">=") else "upper"
            if kind in seen:
                self._twice(clause, seen[kind], kind, of)
            seen.setdefault(kind, clause)
        self.clauses = tuple(clauses)
        lists = {"bounds": tuple(bounds), "contracts": tuple(contracts), "further": tuple(further)}
        return {kind: c.content for kind, c in seen.items()} | lists

    @staticmethod
    def _elsewhere(clause: Clause, first: Clause, further: list[ast.Grouping]) -> bool:
        """Whether a further `per` names another column than those before."""
        return clause.content.column.value not in {one.column.value for one in (first.content, *further)}

    def _twice(self, clause: Clause, first: Clause, kind: str, of: str) -> None:
        self.report(
            Diagnostic(
                "GB126",
                f"{of} has only one {CLAUSE_WORDS[kind]}, and here is a second",
                clause.span,
                labels=(Label(first.span, "the first"),),
                help="keep one of the two",
            )
        )
