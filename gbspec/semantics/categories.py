"""`condition strain in {"wild type", mutant}`: the names of categories stand for their numbers, from 0 on.

They are replaced before names and units are checked, so that all that follows sees a number compared with a condition;
the condition keeps the names, by which tables have them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from gbspec.diagnostics import Findings
from gbspec.ir import category_text
from gbspec.semantics.expressions import walk
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.rewriting import rebuilt, with_expressions
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import Place, ast

Known = Mapping[str, tuple[str, ...]]
"""The categories of each condition that has some."""


def expand(merged: Merged, findings: Findings) -> Merged:
    """The statements with numbers in place of the names of categories (GB379, GB380, GB381)."""
    known: dict[str, tuple[str, ...]] = {}
    for item in merged.items:
        statement = item.statement
        if isinstance(statement, ast.ConditionStatement) and statement.categories is not None:
            known[statement.name.text] = _listed(statement, findings)
    if not known and not any(isinstance(node, ast.Quoted) for item in merged.items for node in _nodes(item)):
        return merged
    return replace(merged, items=tuple(_put(item, known, findings) for item in merged.items))


def _nodes(item: Item) -> list[ast.Expression]:
    return [node for place in item.statement.places() for node in walk(place.expression)]


def _listed(statement: ast.ConditionStatement, findings: Findings) -> tuple[str, ...]:
    """The names of a condition's categories; what is wrong with them is reported (GB381)."""
    assert statement.categories is not None
    names = tuple(name.text for name in statement.categories.names)
    example = "write e.g. `condition strain in {wild, mutant}`"
    if len(names) < 2:
        message = f"the condition `{statement.name.text}` has one category only"
        findings.error("GB381", message, statement.categories.span, help=example)
    for place, name in enumerate(statement.categories.names):
        if not name.text:
            findings.error("GB381", "a category without a name", name.span, help=example)
        elif name.text in names[:place]:
            findings.error("GB381", f"the category `{name.text}` is listed twice", name.span, help="delete one of them")
    for part, what in ((statement.unit, "unit"), (statement.range, "range")):
        if part is not None:
            message = f"a condition with categories has no {what}"
            findings.error("GB381", message, part.span, help=f"delete the {what}, or the categories")
    return names


def _put(item: Item, known: Known, findings: Findings) -> Item:
    statement = item.statement
    if isinstance(statement, ast.ConditionStatement) and statement.categories is not None:
        return Item(_numbered(statement, known[statement.name.text], findings), item.text)

    if isinstance(statement, ast.UnknownStatement):
        for argument in statement.arguments:
            if argument.name.text in known:
                _not_a_number(argument.name, known, findings)

    def change(place: Place) -> ast.Expression:
        here = {name: names for name, names in known.items() if name not in place.formals}  # arguments shadow

        def wanted(node: ast.Expression) -> bool:
            return any(_is_category(part, here) for part in (node, *_sides(node)))

        return rebuilt(place.expression, lambda node: _in_numbers(node, here, findings), wanted)

    return Item(with_expressions(statement, change), item.text)


def _numbered(statement: ast.ConditionStatement, names: tuple[str, ...], findings: Findings) -> ast.ConditionStatement:
    """The condition with the number of its default, and the range of the numbers."""
    assert statement.categories is not None
    default, span = statement.default, statement.categories.span
    if default is not None:
        default = _number(default, statement.name.text, names, findings)
    range = ast.Interval(span, ast.Number(span, "0"), ast.Number(span, str(max(len(names) - 1, 1))))
    return replace(statement, unit=None, range=range, default=default)


def _sides(node: ast.Expression) -> tuple[ast.Expression, ...]:
    return (node.left, node.right) if isinstance(node, ast.Comparison) and node.operator == "==" else ()


def _is_category(node: ast.Expression, known: Known) -> bool:
    """Whether this is a condition with categories, or a text in quotes."""
    return isinstance(node, ast.Quoted) or (isinstance(node, ast.Name) and node.text in known)


def _in_numbers(node: ast.Expression, known: Known, findings: Findings) -> ast.Expression:
    """An equality with a number in place of the category's name; what is no such equality is reported (GB380)."""
    if isinstance(node, ast.Comparison):
        for left, right in ((node.left, node.right), (node.right, node.left)):
            if isinstance(left, ast.Name) and left.text in known and not isinstance(left, ast.Quoted):
                return replace(node, left=left, right=_number(right, left.text, known[left.text], findings))
    text = next((part for part in (*_sides(node), node) if isinstance(part, ast.Quoted)), None)
    if text is not None:
        message = f'`"{text.text}"` stands for a category, which only a condition with categories is compared with'
        help = 'write e.g. `strain == "wild type"`, with `condition strain in {"wild type", mutant}`'
        findings.error("GB380", message, text.span, help=help)
    elif isinstance(node, ast.Name):
        _not_a_number(node, known, findings)
    return ast.Number(node.span, "0")


def _not_a_number(name: ast.Name, known: Known, findings: Findings) -> None:
    message = f"`{name.text}` is one of some categories, not a number: it is compared by `==`"
    help = f"write e.g. `if({name.text} == {category_text(known[name.text][0])}, 1, 0)`, in a `let` for an unknown"
    findings.error("GB380", message, name.span, help=help)


def _number(node: ast.Expression, condition: str, names: tuple[str, ...], findings: Findings) -> ast.Number:
    """The number of a category; another name is reported (GB379)."""
    name = node.text if isinstance(node, ast.Name) else node.span.text
    if name in names and isinstance(node, ast.Name):
        return ast.Number(node.span, str(names.index(name)))
    listed = "its categories are " + ", ".join(f"`{category_text(one)}`" for one in names)
    message = f"`{condition}` has no category `{name}`"
    findings.error("GB379", message, node.span, help=suggestion(name, set(names)) or listed)
    return ast.Number(node.span, "0")
