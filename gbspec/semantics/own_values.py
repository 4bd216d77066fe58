"""`learn k = 1 per strain` without a distribution: a constant for each category of the condition `strain`.

`k` becomes the constants `k_wild` and `k_mutant`, and `let k = if(strain == wild, k_wild, k_mutant)`, so that its name
stands wherever that of a `let` may, and is shadowed like it.
"""

from __future__ import annotations

import re
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics.merge import Item, Merged
from gbspec.syntax import ast


@dataclass(frozen=True)
class Owned:
    """The constants that stand for one: the condition that chooses, its categories, and a constant for each."""

    condition: str
    categories: tuple[ast.Name, ...]
    names: tuple[str, ...]


def expand(merged: Merged, findings: Findings) -> Merged:
    """The statements with a constant for each category in place of those that differ between categories.

    Reports constants that would have the name of another one, or of something else (GB382).
    """
    statements = [item.statement for item in merged.items]
    known = {
        one.name.text: one.categories.names
        for one in statements
        if isinstance(one, ast.ConditionStatement) and one.categories is not None
    }
    taken = {name.text: name.span for one in statements for name in one.declares()}
    owned: dict[str, Owned] = {}
    for learned in statements:
        if not isinstance(learned, ast.LearnStatement) or learned.row or len(learned.groupings) != 1:
            continue
        (grouping,) = learned.groupings
        if grouping.spread is None and grouping.column.value in known:
            owned[learned.name.text] = _named(learned, grouping.column.value, known, taken, findings)
    if not owned:
        return merged
    return replace(merged, items=tuple(one for item in merged.items for one in _put(item, owned, taken)))


def _named(
    learned: ast.LearnStatement,
    condition: str,
    known: Mapping[str, tuple[ast.Name, ...]],
    taken: Mapping[str, Span],
    findings: Findings,
) -> Owned:
    """The names of the constants of one that differs; a name that is not free is reported (GB382)."""
    names: dict[str, ast.Name] = {}
    for category in known[condition]:
        name = f"{learned.name.text}_{_word(category.text)}"
        first = names.setdefault(name, category)
        if first.text != category.text:
            message = f"`{name}` would be the constant of two categories, `{first.text}` and `{category.text}`"
            labels = [Label(category.span, "this one"), Label(first.span, "and this one")]
            help = "rename one of them: in names of constants only letters and digits tell categories apart"
            findings.error("GB382", message, learned.name.span, labels=labels, help=help)
        elif name in taken and first is category:
            message = (
                f"`{name}` is also the name of the constant `{learned.name.text}` for the category `{category.text}`"
            )
            help = f"rename it, or `{learned.name.text}`"
            labels = [Label(learned.name.span, "with a constant for each category")]
            findings.error("GB382", message, taken[name], labels=labels, help=help)
    return Owned(condition, known[condition], tuple(f"{learned.name.text}_{_word(c.text)}" for c in known[condition]))


def _word(name: str) -> str:
    """A category's name as part of a name: `wild_type` for `wild type`."""
    return re.sub(r"\W+", "_", name).strip("_")


def _put(item: Item, owned: Mapping[str, Owned], taken: Container[str]) -> list[Item]:
    """The statements in place of one; its text, which the model of a run keeps, is that of the first."""
    made = _made(item.statement, owned, taken)
    return [Item(one, "" if number else item.text) for number, one in enumerate(made)]


def _made(statement: ast.Statement, owned: Mapping[str, Owned], taken: Container[str]) -> list[ast.Statement]:
    match statement:
        case ast.LearnStatement(name=name) if name.text in owned:
            one = owned[name.text]
            each = (ast.Name(name.span, text) for text in dict.fromkeys(one.names) if text not in taken)
            chosen = ast.LetStatement(statement.span, name, _chosen(one, name.span), statement.unit)
            return [*(replace(statement, name=own, per=None) for own in each), chosen]
        case ast.TruthStatement(target=target, parameters=None, index=None) if target.text in owned:
            return [replace(statement, target=ast.Name(target.span, text)) for text in owned[target.text].names]
        case ast.AllowStatement(name=ast.Name() as name) if name.text in owned:
            return [statement, *(replace(statement, name=ast.Name(name.span, t)) for t in owned[name.text].names)]
        case _:
            return [statement]


def _chosen(one: Owned, span: Span) -> ast.Expression:
    """The constant of the trajectory's category."""
    found: ast.Expression = ast.Name(span, one.names[-1])
    for category, name in reversed(list(zip(one.categories[:-1], one.names[:-1], strict=True))):
        equal = ast.Comparison(span, "==", ast.Name(span, one.condition), category)
        found = ast.Conditional(span, equal, ast.Name(span, name), found)
    return found
