"""Every expression of a model, with the place it stands in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from gbspec.diagnostics import Span
from gbspec.semantics.merge import Item
from gbspec.semantics.table import Table
from gbspec.syntax import Kind, Place, ast, rules


@dataclass
class References:
    """What an expression names, its own arguments apart.

    `smooth`: names that stand somewhere outside the condition of an `if`. `complete` is False where something in the
    expression was wrong and has been told; what depends on it is then left alone.
    """

    names: dict[str, Span] = field(default_factory=dict)
    nets: dict[str, Span] = field(default_factory=dict)
    smooth: set[str] = field(default_factory=set)
    complete: bool = True


@dataclass
class Site(Place):
    """A place, and what its expression names."""

    references: References = field(default_factory=References)


class Sites:
    """All expressions of a model, in order; each is found by itself, for equal ones may stand in several places."""

    def __init__(self, items: Iterable[Item], table: Table) -> None:
        self._all = tuple(_sites(items, table))
        self._by_expression = {id(site.expression): site for site in self._all}

    def __iter__(self) -> Iterator[Site]:
        return iter(self._all)

    def __getitem__(self, expression: ast.Expression) -> Site:
        return self._by_expression[id(expression)]

    def complete(self, expression: ast.Expression | None) -> bool:
        """Whether an expression of the model stands here in which nothing was reported."""
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
                    site.rule = rules.TRUTH_NUMBER
            yield site


def truth_parameters(truth: ast.TruthStatement, table: Table) -> tuple[str, ...]:
    """The parameters of a truth; of an unknown named without parentheses, its arguments as declared."""
    if truth.parameters is not None:
        return tuple(parameter.text for parameter in truth.parameters)
    declaration = table.get(truth.target.text)
    if declaration is None or not isinstance(declaration.statement, ast.UnknownStatement):
        return ()
    return tuple(argument.name.text for argument in declaration.statement.arguments)
