"""The TextMate grammar and the VS Code extension are in step with the language."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gbspec.data.shipped import shipped_models
from gbspec.lsp import words
from gbspec.lsp.semantic import MODIFIERS, TYPES
from gbspec.lsp.textmate import FILES, grammar
from gbspec.semantics.vocabulary import ACTIVATIONS
from gbspec.syntax.ast import WORDS as STATEMENTS
from gbspec.syntax.grammar import grammar_file
from gbspec.syntax.names import FUNCTIONS

GRAMMAR: dict[str, Any] = json.loads(grammar())
VSCODE = grammar_file("gb.lark").parent / "vscode"

# Oniguruma, which editors use, and Python agree on these constructs; any other construct fails here.
PLAIN = re.compile(r"\(\?(?!:|=|!|<=|<!)|\\[pPhHRXKGg]|[*+?]\+|\(\?>")


def rules(patterns: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for pattern in patterns:
        if "include" in pattern:
            yield from rules([GRAMMAR["repository"][pattern["include"].removeprefix("#")]])
        elif "patterns" in pattern:
            yield from rules(pattern["patterns"])
        else:
            yield pattern


RULES = [(re.compile(rule["match"]), rule) for rule in rules(GRAMMAR["patterns"])]


def tokens(line: str) -> list[tuple[str, str]]:
    """The parts of a line with their scopes: the earliest match, among several the first rule's, as in editors."""
    found: list[tuple[str, str]] = []
    position = 0
    while position < len(line):
        matches = [
            (m.start(), i) for i, (pattern, _) in enumerate(RULES) if (m := pattern.search(line, position)) and m[0]
        ]
        if not matches:
            break
        start, index = min(matches)
        pattern, rule = RULES[index]
        match = pattern.search(line, start)
        assert match is not None
        if "name" in rule:
            found.append((match[0], rule["name"]))
        for group, scope in rule.get("captures", {}).items():
            if match[int(group)]:
                found.append((match[int(group)], scope["name"]))
        position = match.end()
    return found


@pytest.mark.parametrize("pattern", [rule["match"] for _, rule in RULES])
def test_the_patterns_mean_the_same_to_every_editor(pattern: str) -> None:
    assert not PLAIN.search(pattern)


@pytest.mark.parametrize("word", STATEMENTS)
def test_every_statement_is_highlighted(word: str) -> None:
    argument = "GB403 x" if word == "allow" else "x"
    assert tokens(f"{word} {argument}")[0] == (word, "keyword.control.statement.gb")
    assert tokens(word) == [(word, "keyword.control.statement.gb")]
    assert (word, "keyword.control.statement.gb") not in tokens(f"x' = {word}*2")


@pytest.mark.parametrize("word", [*FUNCTIONS, "net", "sum"])
def test_every_function_is_highlighted(word: str) -> None:
    assert (word, "support.function.gb") in tokens(f"let a = {word}(x)")


@pytest.mark.parametrize("word", words.CLAUSES)
def test_every_clause_is_highlighted_and_a_name_is_not(word: str) -> None:
    assert (word, "keyword.other.clause.gb") in tokens(f"state x {word} [1, 2]")
    assert (word, "keyword.other.clause.gb") not in tokens(f"let a = {word}*2")


@pytest.mark.parametrize("word", words.OPERATORS)
def test_every_word_of_expressions_is_highlighted(word: str) -> None:
    assert any(text == word and scope.startswith("keyword") for text, scope in tokens(f"let a = {word} (b)"))


@pytest.mark.parametrize("word", [*words.VALUES])
def test_the_words_with_a_value_are_highlighted(word: str) -> None:
    assert (word, "constant.language.gb") in tokens(f"let a = 2*{word}")


@pytest.mark.parametrize("word", [*words.NETWORKS, *words.DISTRIBUTIONS, *words.NOISES])
def test_networks_and_distributions_are_highlighted(word: str) -> None:
    assert (word, "support.type.gb") in tokens(f"    {word}(3)")


@pytest.mark.parametrize("word", ACTIVATIONS)
def test_activations_are_highlighted(word: str) -> None:
    assert (word, "support.constant.gb") in tokens(f"unknown f(x) by mlp(3, activation={word})")


def test_the_files_are_those_that_the_words_of_the_language_give() -> None:
    for name in FILES:
        again = "regenerate it: python -m gbspec.lsp.textmate"
        assert (VSCODE.parent / name).read_text(encoding="utf-8") == grammar(), again


def test_a_line_is_read_as_a_person_reads_it() -> None:
    assert tokens('learn β = 1.5e-3 in [0, 10] "cooling # coefficient" # a comment') == [
        ("learn", "keyword.control.statement.gb"),
        ("β", "variable.other.declaration.gb"),
        ("=", "keyword.operator.gb"),
        ("1.5e-3", "constant.numeric.gb"),
        ("in", "keyword.other.clause.gb"),
        ("0", "constant.numeric.gb"),
        ("10", "constant.numeric.gb"),
        ('"cooling # coefficient"', "string.quoted.double.gb"),
        ("# a comment", "comment.line.number-sign.gb"),
    ]
    assert tokens("x1' = -x1 + φ(x1)") == [
        ("x1", "variable.other.state.gb"),
        ("'", "keyword.operator.derivative.gb"),
        ("=", "keyword.operator.gb"),
        ("-", "keyword.operator.gb"),
        ("+", "keyword.operator.gb"),
        ("φ", "entity.name.function.call.gb"),
    ]


@pytest.mark.parametrize("path", sorted(shipped_models().values()), ids=lambda p: p.stem)
def test_every_statement_of_the_bundled_models_is_seen(path: Path) -> None:
    for line in path.read_text(encoding="utf-8").splitlines():
        if line and not line[0].isspace() and not line.startswith(("#", ")", "]")):
            scopes = {scope for _, scope in tokens(line)}
            operators = {f"keyword.operator.{kind}.gb" for kind in ("derivative", "closure")}
            assert scopes & {"keyword.control.statement.gb", *operators}, line


def test_the_extension_names_files_that_are_there_and_starts_the_server() -> None:
    package = json.loads((VSCODE / "package.json").read_text())
    named = ["extension.js", package["icon"], "LICENSE", "README.md", "package-lock.json"]
    named.append(package["contributes"]["languages"][0]["configuration"])
    named += [grammar["path"] for grammar in package["contributes"]["grammars"]]
    assert all((VSCODE / name).is_file() for name in named)
    assert package["contributes"]["configuration"]["properties"]["gbspec.command"]["default"] == ["gbspec", "lsp"]
    assert package["contributes"]["grammars"][0]["scopeName"] == GRAMMAR["scopeName"]
    configuration = json.loads((VSCODE / "language-configuration.json").read_text())
    assert configuration["comments"] == {"lineComment": "#"}


def test_the_extension_is_bundled_and_packaged_by_continuous_integration() -> None:
    package = json.loads((VSCODE / "package.json").read_text())
    assert package["scripts"]["vscode:prepublish"] == "npm run bundle"
    assert "extension.js --bundle" in package["scripts"]["bundle"]
    assert package["scripts"]["bundle"].endswith(f"--outfile={package['main'].removeprefix('./')}")
    ignored = (VSCODE / ".vscodeignore").read_text().splitlines()
    assert {"node_modules/**", "extension.js"} <= set(ignored), "the bundle has what is needed of both"
    icon = (VSCODE / package["icon"]).read_bytes()
    assert icon.startswith(b"\x89PNG")
    assert int.from_bytes(icon[16:20]) == int.from_bytes(icon[20:24]) >= 128
    root = VSCODE.parent.parent
    assert (VSCODE / "LICENSE").read_text() == (root / "LICENSE").read_text()
    locked = (VSCODE / "package-lock.json").read_text()
    assert '"resolved"' not in locked, "the registry is the one of whoever installs"
    workflow = (root / ".github" / "workflows" / "ci.yml").read_text()
    assert "npm run package" in workflow
    assert "repository.url=" in workflow


def test_the_extension_knows_the_tokens_of_the_server() -> None:
    contributed = json.loads((VSCODE / "package.json").read_text())["contributes"]
    standard = {"declaration", "readonly", "defaultLibrary"}
    assert {one["id"] for one in contributed["semanticTokenModifiers"]} == set(MODIFIERS) - standard
    (scopes,) = (one["scopes"] for one in contributed["semanticTokenScopes"])
    for selector in scopes:
        kind, *modifiers = selector.split(".")
        assert kind in TYPES
        assert set(modifiers) <= set(MODIFIERS)
