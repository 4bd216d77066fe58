"""Every expression of a model with its place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from gbspec.diagnostics import Span
from gbspec.semantics.merge import Item
from gbspec.semantics.table import Table
from gbspec.syntax import TRUTH_NUMBER, Kind, Place, ast


@dataclass
class References:
    """The names that an expression refers to, except its own arguments.

    `smooth`: names that occur somewhere outside the condition of an `if`. `complete` is False if an error in the
    expression was reported; further checks that depend on it are then skipped.
    """

    names: dict[str, Span] = field(default_factory=dict)
    nets: dict[str, Span] = field(default_factory=dict)
    smooth: set[str] = field(default_factory=set)
    complete: bool = True


@dataclass
class Site(Place):
    """A place, and the names that its expression refers to."""

    references: References = field(default_factory=References)


class Sites:
    """All expressions of a model, in order; looked up by identity, since equal ones may occur in several places."""

    def __init__(self, items: Iterable[Item], table: Table) -> None:
        self._all = tuple(_sites(items, table))
        self._by_expression = {id(site.expression): site for site in self._all}

    def __iter__(self) -> Iterator[Site]:
        return iter(self._all)

    def __getitem__(self, expression: ast.Expression) -> Site:
        return self._by_expression[id(expression)]

    def complete(self, expression: ast.Expression | None) -> bool:
        """Whether an expression is one of the model's and has no reported error."""
        site = self._by_expression.get(id(expression))
        return site is not None and site.references.complete


def _sites(items: Iterable[Item], table: Table) -> Iterator[Site]:
    for item in items:
        for place in item.statement.places():
            site = Site(**vars(place))
            if isinstance(item.statement, ast.TruthStatement):
                site.formals = frozenset(truth_parameters(item.statement, table))
                declaration = table.get(item.statement.target.text)
                if declaration is not None and declaration.kind is Kind.LEARN:
                    site.rule = TRUTH_NUMBER
            yield site


def truth_parameters(truth: ast.TruthStatement, table: Table) -> tuple[str, ...]:
    """The parameters of a truth; without parentheses, the declared arguments of its unknown."""
    if truth.parameters is not None:
        return tuple(parameter.text for parameter in truth.parameters)
    declaration = table.get(truth.target.text)
    if declaration is None or not isinstance(declaration.statement, ast.UnknownStatement):
        return ()
    return tuple(argument.name.text for argument in declaration.statement.arguments)
