"""`learn k = 1 per strain` without a distribution: a constant for each category of the condition `strain`.

`k` becomes `k_wild` and `k_mutant`, and in expressions `if(strain == wild, k_wild, k_mutant)`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.rewriting import rebuilt, with_expressions
from gbspec.syntax import Place, ast


@dataclass(frozen=True)
class Owned:
    """The constants that stand for one: the condition that chooses, its categories, and a constant for each."""

    condition: str
    categories: tuple[ast.Name, ...]
    names: tuple[str, ...]


def expand(merged: Merged) -> Merged:
    """The statements with a constant for each category in place of those that differ between categories."""
    known = {
        item.statement.name.text: item.statement.categories.names
        for item in merged.items
        if isinstance(item.statement, ast.ConditionStatement) and item.statement.categories is not None
    }
    owned: dict[str, Owned] = {}
    for item in merged.items:
        learned = item.statement
        if not isinstance(learned, ast.LearnStatement) or learned.row or len(learned.groupings) != 1:
            continue
        (grouping,) = learned.groupings
        if grouping.spread is None and grouping.column.value in known:
            categories = known[grouping.column.value]
            names = tuple(f"{learned.name.text}_{_word(name.text)}" for name in categories)
            owned[learned.name.text] = Owned(grouping.column.value, categories, names)
    if not owned:
        return merged
    return replace(merged, items=tuple(one for item in merged.items for one in _put(item, owned)))


def _word(name: str) -> str:
    """A category's name as part of a name: `wild_type` for `wild type`."""
    return re.sub(r"\W+", "_", name).strip("_")


def _put(item: Item, owned: dict[str, Owned]) -> list[Item]:
    statement = item.statement
    if isinstance(statement, ast.LearnStatement) and statement.name.text in owned:
        names = (ast.Name(statement.name.span, name) for name in owned[statement.name.text].names)
        return [Item(replace(statement, name=name, per=None), item.text) for name in names]

    def change(place: Place) -> ast.Expression:
        return rebuilt(place.expression, lambda node: _chosen(node, owned), lambda node: _is_owned(node, owned))

    return [Item(with_expressions(statement, change), item.text)]


def _is_owned(node: ast.Expression, owned: dict[str, Owned]) -> bool:
    return isinstance(node, ast.Name) and node.text in owned


def _chosen(node: ast.Expression, owned: dict[str, Owned]) -> ast.Expression:
    """The constant of the trajectory's category."""
    assert isinstance(node, ast.Name)
    one, span = owned[node.text], node.span
    found: ast.Expression = ast.Name(span, one.names[-1])
    for category, name in reversed(list(zip(one.categories[:-1], one.names[:-1], strict=True))):
        equal = ast.Comparison(span, "==", ast.Name(span, one.condition), category)
        found = ast.Conditional(span, equal, ast.Name(span, name), found)
    return found
