"""From text to tree: one statement at a time, so that a mistake in one hides none in the others."""

from __future__ import annotations

import re
from typing import cast

from lark.exceptions import UnexpectedInput

from gbspec.diagnostics import Findings, Source, Span
from gbspec.syntax import ast
from gbspec.syntax.characters import clean
from gbspec.syntax.grammar import engine
from gbspec.syntax.names import normalise
from gbspec.syntax.reading import read_source
from gbspec.syntax.statements import Chunk, split

__all__ = ["parse", "parse_expression", "read_source"]

_WORD = re.compile(r"[^\W\d]\w*")


def parse(source: Source, findings: Findings) -> ast.File | None:
    """The tree of a file. Every syntax error is recorded; the statements that hold one are left out of the tree.

    None where no statement could be read though there are some.
    """
    layout = split(source)
    statements: list[ast.Statement] = []
    uncertain: set[str] = set()
    for chunk in layout.chunks:
        statement = _statement(chunk, findings)
        if statement is not None:
            statements.append(statement)
        else:
            uncertain.update(normalise(word) for word in _WORD.findall(chunk.span.text))
    if layout.chunks and not statements:
        return None
    return ast.File(Span(source, 0, len(source.text)), tuple(statements), frozenset(uncertain))


def _statement(chunk: Chunk, findings: Findings) -> ast.Statement | None:
    text, problems = clean(chunk)
    findings.extend(problems)
    if text is None:
        return None
    lark, builder = engine()
    builder.begin(chunk.source, chunk.start)
    try:
        statement = cast(ast.Statement, lark.parse(text, start="statement"))
    except UnexpectedInput as error:
        at = chunk.start + min(error.pos_in_stream or 0, len(text) - 1)
        findings.error("GB100", "unexpected", Span(chunk.source, at, at + 1))
        return None
    findings.extend(builder.problems)
    return None if builder.problems else statement


def parse_expression(source: Source, findings: Findings) -> ast.Expression | None:
    """The tree of a lone expression, a condition allowed (`x2 > 4`)."""
    lark, builder = engine()
    builder.begin(source, 0)
    try:
        return cast(ast.Expression, lark.parse(source.text, start="expression"))
    except UnexpectedInput as error:
        at = error.pos_in_stream or 0
        findings.error("GB100", "unexpected", Span(source, at, at + 1))
        return None
