"""Generates the TextMate grammar, with which editors highlight files, from the words of the language.

    python -m gbspec.lsp.textmate

rewrites it, for editors in general and for the VS Code extension, which needs a copy in its own folder.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import TypeAlias

from gbspec.lsp import words
from gbspec.syntax import Kind, ast, grammar_file

Pattern: TypeAlias = "dict[str, str | dict[str, dict[str, str]] | list[Pattern]]"

FILES = ("gb.tmLanguage.json", "vscode/gb.tmLanguage.json")
"""The file's path below the folder `grammar`."""

_NAME = r"[^\W\d]\w*"
_KEYWORD = "keyword.control.statement.gb"


def grammar() -> str:
    """The text of the file."""
    repository = _repository()
    whole = {
        "$schema": "https://raw.githubusercontent.com/martinring/tmlanguage/master/tmlanguage.json",
        "name": "gb",
        "scopeName": "source.gb",
        "fileTypes": ["gb"],
        "patterns": [{"include": f"#{name}"} for name in repository],
        "repository": repository,
    }
    return json.dumps(whole, indent=2) + "\n"


def _match(pattern: str, scope: str = "", *captures: str, comment: str = "") -> Pattern:
    """A rule, with the scope of the whole match, or of each of its groups (empty: none)."""
    rule: Pattern = {"comment": comment} if comment else {}
    if scope:
        rule["name"] = scope
    rule["match"] = pattern
    if captures:
        rule["captures"] = {str(i): {"name": name} for i, name in enumerate(captures, start=1) if name}
    return rule


def _any(words: Iterable[str]) -> str:
    return "|".join(words)


def _repository() -> dict[str, Pattern]:
    """The rules, in the order in which an editor tries them."""
    functions, types = _any(words.FUNCTIONS), _any([*words.NETWORKS, *words.DISTRIBUTIONS, *words.NOISES])
    state, operator = "variable.other.state.gb", "keyword.operator.gb"
    return {
        "comment": {"name": "comment.line.number-sign.gb", "match": "#.*$"},
        "string": {"name": "string.quoted.double.gb", "match": '"[^"]*(?:"|$)'},
        "declaration": {"patterns": _statements()},
        "balance": {
            "patterns": [
                _match(rf"^({_NAME})(\s*\[[^\]]*\])?\s*(')", "", state, "", "keyword.operator.derivative.gb"),
                _match(rf"^({_NAME})\s*\[[^\]]*\]\s*(=)(?!=)", "", state, "keyword.operator.closure.gb"),
            ]
        },
        "statement": _match(
            rf"^(?:{_any(ast.WORDS)})$",
            _KEYWORD,
            comment="An incomplete statement: only its keyword, in the first column.",
        ),
        "conditional": {
            "patterns": [
                _match(r"\bif\b(?=\s*\()", "keyword.control.conditional.gb"),
                _match(rf"\b(?:{_any(w for w in words.OPERATORS if w != 'if')})\b", "keyword.operator.logical.gb"),
            ]
        },
        "function": {
            "patterns": [
                _match(rf"\b(?:{functions})\b(?=\s*\()", "support.function.gb"),
                _match(rf"\b(?:{types})\b(?=\s*\()", "support.type.gb"),
                _match(rf"\b{_NAME}(?=\s*\()", "entity.name.function.call.gb"),
            ]
        },
        "constant": _match(rf"\b(?:{_any(words.VALUES)})\b", "constant.language.gb"),
        "word": _match(
            rf"\b({_any(words.OPTIONS)})\s*(=)\s*({_NAME})",
            "",
            "variable.parameter.gb",
            operator,
            "support.constant.gb",
        ),
        "clause": _match(
            rf"""(?<=[\s\)\]\",])(?:{_any(words.CLAUSES)})\b(?!\s*(?:[*/^,)'=]|[-+]\s))""",
            "keyword.other.clause.gb",
            comment="A clause's keyword counts only where the grammar expects it; "
            "before an operator, a bracket or a comma it is a name.",
        ),
        "number": _match(
            r"(?<![\w.])(?:\d+(?:\.(?!\.)\d*)?|\.\d+)(?:[eE][+-]?\d+)?",
            "constant.numeric.gb",
        ),
        "operator": _match(r"->|\.\.|\*\*|<=|>=|==|[-+*/^<>=]", operator),
    }


def _statements() -> list[Pattern]:
    """The rules for keywords of statements, grouped by the scope of the following name."""
    by_scope: dict[str, list[str]] = {}
    for statement in ast.STATEMENTS:
        if statement.entry.spelled:
            by_scope.setdefault(_scope(statement), []).append(statement.entry.word)
    several = rf"{_NAME}(?:\s*,\s*{_NAME})*"
    following = {"entity.name.function.gb": several, "constant.other.code.gb": r"GB\d+"}
    return [
        _match(rf"^({_any(spelled)})\s+({following.get(scope, _NAME)})", "", _KEYWORD, scope)
        if scope
        else _match(rf'^({_any(spelled)})\s+(?={_NAME}|")', "", _KEYWORD)
        for scope, spelled in by_scope.items()
    ]


def _scope(statement: type[ast.Statement]) -> str:
    """The scope of the name after a statement's keyword; empty without a special one."""
    kind = statement.entry.kind
    if statement is ast.ModelStatement:
        return "entity.name.type.gb"
    if statement is ast.AllowStatement:
        return "constant.other.code.gb"
    if kind in (Kind.FUNCTION, Kind.TABLE, Kind.UNKNOWN):
        return "entity.name.function.gb"
    if statement is ast.UnitStatement or kind not in (None, Kind.CHANNEL):
        return "variable.other.declaration.gb"
    return ""


def main() -> None:
    """Writes the files."""
    folder = grammar_file("gb.lark").parent
    for name in FILES:
        (folder / name).write_text(grammar(), encoding="utf-8")


if __name__ == "__main__":
    main()
