"""The words that the editor explains are those of the language, each with its meaning."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gbspec.diagnostics.catalogue import explain
from gbspec.lsp import words
from gbspec.lsp.completion import completions
from gbspec.lsp.messages import UNUSED
from gbspec.lsp.workspace import Workspace
from gbspec.syntax import names
from gbspec.syntax.expectations import Expected, expected
from gbspec.syntax.grammar import engine


def keywords() -> set[str]:
    lark, _ = engine()
    found = Expected(frozenset(t.name for t in lark.terminals), ()).keywords
    return set(found)


def test_every_keyword_of_the_grammar_is_explained() -> None:
    assert keywords() == {*words.STATEMENTS, *words.CLAUSES, *words.OPERATORS}


def test_every_function_is_explained_and_written_with_its_arguments() -> None:
    assert set(words.FUNCTIONS) == {*names.FUNCTIONS, "net", "sum", "delay"}
    for function, (usage, meaning) in words.FUNCTIONS.items():
        assert meaning
        inside = re.fullmatch(rf"{function}\((.*)\)", usage)
        assert inside is not None
        given = [a for a in inside[1].split(", ") if a != "…"]
        assert len(given) == names.FUNCTIONS.get(function, 2 if function == "delay" else 1)


def test_the_code_that_is_shown_faded_is_that_of_unused_names() -> None:
    assert "never used" in explain(UNUSED).title


@pytest.mark.parametrize(
    ("begun", "keyword", "not_keyword"),
    [
        ("model m ", "extends", "in"),
        ("input F ", "held", "prior"),
        ("initial X ", "learn", "in"),
        ("process p: A -> B ", "rate", "in"),
        ("unknown f(x) ", "by", "prior"),
        ("unknown f(x) zero ", "at", "in"),
        ("let a = if(b > 1 ", "and", "rate"),
    ],
)
def test_the_grammar_says_which_word_may_follow(begun: str, keyword: str, not_keyword: str) -> None:
    what = expected(begun)
    assert what is not None
    assert keyword in what.keywords
    assert not_keyword not in what.keywords


@pytest.mark.parametrize("begun", ["state state state", "let = ", "const a = 1 1", "$ = 1"])
def test_after_what_is_wrong_nothing_is_expected(begun: str) -> None:
    assert expected(begun) is None


@pytest.mark.parametrize(
    ("begun", "files"),
    [
        ('model m extends "', ["base.gb"]),
        ('table ocv(soc) : V from "', ["ocv.csv", "points/rates.tsv"]),
        ('table ocv(soc) : V from "oc', ["ocv.csv", "points/rates.tsv"]),
        ('state x "from "', []),
    ],
)
def test_names_of_files_are_completed_where_a_file_is_named(begun: str, files: list[str], tmp_path: Path) -> None:
    (tmp_path / "points").mkdir()
    for name in ("base.gb", "ocv.csv", "points/rates.tsv", "notes.md"):
        (tmp_path / name).write_text("")
    workspace, path = Workspace(), tmp_path / "m.gb"
    text = begun if begun.startswith("model") else f"model m\n{begun}"
    workspace.put(path, text)
    start, found = completions(workspace, path, len(text))
    assert [one.text for one in found if one.kind == "file"] == files
    assert not files or text[start - 1] == '"'
