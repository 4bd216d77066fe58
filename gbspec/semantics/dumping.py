"""The result of the semantic checks as text (`--dump`)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from gbspec.semantics.checked import Checked
from gbspec.semantics.processes import Term
from gbspec.syntax import ast, prefix, statement_lines


def dump(checked: Checked) -> str:
    """Names, constants and processes, then the statements, merged and with arrays expanded.

    Ends with a line end.
    """
    lines = [
        *_section("names", (f"{name}: {found.kind.value}" for name, found in checked.table.items())),
        *_section("order of `let`s and processes", checked.order),
        *_section("constants", (f"{name} = {value!r}" for name, value in checked.constants.items())),
        *_section("processes", (f"{name}: {_sides(terms)}" for name, terms in checked.terms.items())),
        *_section("arrays", (f"{name}: {array.range}" for name, array in checked.arrays.items())),
        *_section("truths of constants", (f"{name} = {value!r}" for name, value in checked.truths.items())),
        *_section("allowed", (code if name is None else f"{code} {name}" for code, name in checked.allowed)),
        *_section("statements", (line for item in checked.items for line in _statement(item.statement))),
    ]
    return "\n".join(lines) + "\n"


def _statement(statement: ast.Statement) -> list[str]:
    """The lines of a statement, with the name of its file, since a model may extend another."""
    return statement_lines(statement, Path(statement.span.source.path).name)


def _section(title: str, entries: Iterable[str]) -> list[str]:
    body = [f"  {entry}" for entry in entries]
    return [title, *body] if body else []


def _sides(terms: Sequence[tuple[bool, Term]]) -> str:
    """Both sides, each term with its coefficient: `1/Y S -> X`."""
    left, right = (" + ".join(_term(term) for used, term in terms if used is side) for side in (True, False))
    return f"{left} -> {right}".strip()


def _term(term: Term) -> str:
    factors = "".join(f"{'/' if inverted else '*'}{prefix(factor)}" for inverted, factor in term.factors)
    return f"{'-' if term.negative else ''}{term.state}{factors}"
