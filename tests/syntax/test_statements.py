"""The entry of each statement is complete, and the other layers handle every statement."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator

import pytest

from gbspec.diagnostics import Findings, Source
from gbspec.lower.statements import lower
from gbspec.semantics.balances import _TWICE
from gbspec.semantics.checked import Checked
from gbspec.semantics.checking import check
from gbspec.syntax import ast
from gbspec.syntax.formatter import format_text
from gbspec.syntax.grammar import grammar_file
from gbspec.syntax.parser import parse

NAMES = [kind.__name__ for kind in ast.STATEMENTS]
FIELDS = {
    "UnitExpression": {"unit", "units"},
    "Interval": {"range"},
    "Text": {"title", "description", "extends", "column"},
}
"""Parts that the editor and the check of units find by the name of their field."""


def example(kind: type[ast.Statement]) -> ast.Statement:
    findings = Findings()
    file = parse(Source("example.gb", kind.entry.example), findings)
    assert not list(findings) and file is not None
    (statement,) = file.statements
    return statement


def parts(node: ast.Node, kind: str) -> Iterator[tuple[str, ast.Node]]:
    """The parts of a statement whose fields are of a kind of node, those of its clauses among them."""
    for field in dataclasses.fields(node):
        value = getattr(node, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, ast.Node) and re.search(rf"\b{kind}\b", str(field.type)):
                yield field.name, part
            elif isinstance(part, ast.Node) and not isinstance(part, ast.Expression):
                yield from parts(part, kind)


def test_the_grammar_has_a_rule_for_each_and_no_other() -> None:
    text = grammar_file("gb.lark").read_text(encoding="utf-8")
    alternatives = re.search(r"^\?statement:((?:\s+\|?\s*\w+_statement)+)", text, re.M)
    assert alternatives is not None
    assert set(alternatives[1].replace("|", " ").split()) == {f"{k.entry.word}_statement" for k in ast.STATEMENTS}


@pytest.mark.parametrize("kind", ast.STATEMENTS, ids=NAMES)
def test_the_example_is_the_statement_in_canonical_form(kind: type[ast.Statement]) -> None:
    assert type(example(kind)) is kind
    assert format_text(Source("example.gb", kind.entry.example)) == kind.entry.example + "\n"
    assert (kind.entry.kind is None) == (not kind.entry.role)
    assert kind.entry.meaning


@pytest.mark.parametrize("kind", ast.STATEMENTS, ids=NAMES)
def test_every_expression_has_a_place(kind: type[ast.Statement]) -> None:
    statement = example(kind)
    options = {id(o.value) for o in getattr(getattr(statement, "network", None), "options", ())}
    written = {id(part) for _, part in parts(statement, "Expression")} - options
    assert written == {id(place.expression) for place in statement.places()}


@pytest.mark.parametrize("kind", ast.STATEMENTS, ids=NAMES)
def test_parts_of_a_kind_have_the_fields_in_which_they_are_looked_for(kind: type[ast.Statement]) -> None:
    for part, names in FIELDS.items():
        fields = {f.name for f in dataclasses.fields(kind) if re.search(rf"\b{part}\b", str(f.type))}
        assert fields <= names


def test_a_second_one_about_a_name_is_refused_for_every_kind() -> None:
    assert set(_TWICE) == {kind.entry.word for kind in ast.STATEMENTS if issubclass(kind, ast.About)}


def test_every_statement_is_lowered_or_used_up_before(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "model m\nstate x\nx' = -x\n"
    file, findings = parse(Source("m.gb", text), Findings()), Findings()
    assert file is not None
    checked = check(file, findings, lambda path: pytest.fail(f"reads {path}"))
    assert checked is not None
    asked: set[type] = set()
    all_of = Checked.all
    monkeypatch.setattr(Checked, "all", lambda self, kind: (asked.add(kind), all_of(self, kind))[1])
    lower(checked, findings)
    # names of units, ends of arrays and functions are written out; `let`s come in their order; the rest is no part
    elsewhere = {
        *(ast.UnitStatement, ast.ClosureStatement, ast.FunctionStatement, ast.LetStatement),
        *(ast.AllowStatement, ast.WithoutStatement, ast.DiscreteStatement),
    }
    assert asked | elsewhere == set(ast.STATEMENTS)
    assert not asked & elsewhere
