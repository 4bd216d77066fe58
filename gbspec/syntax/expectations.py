"""What may come next in an incomplete statement, for completion in an editor."""

from __future__ import annotations

import re
from dataclasses import dataclass

from lark.exceptions import UnexpectedInput

from gbspec.diagnostics import Source
from gbspec.syntax.grammar import engine

_LOOK_AHEAD = re.compile(r"\(\?[=!].*\)", re.DOTALL)
"""What has to follow a keyword for it to count as one."""


@dataclass(frozen=True)
class Expected:
    """The grammar's terminals that may come next, and the types and texts of those that were read."""

    terminals: frozenset[str]
    read: tuple[tuple[str, str], ...]

    @property
    def keywords(self) -> tuple[str, ...]:
        """The keywords among these terminals."""
        lark, _ = engine()
        words = {t.name: t.pattern.value for t in lark.terminals if t.pattern.value.endswith(r"\b")}
        return tuple(
            _LOOK_AHEAD.sub("", word).removesuffix(r"\b") for name, word in words.items() if name in self.terminals
        )


def expected(text: str) -> Expected | None:
    """What may follow the beginning of a statement (its comments blanked); None if the beginning has a syntax error."""
    lark, builder = engine()
    builder.begin(Source("", text), 0)
    parser = lark.parse_interactive(text, start="statement")
    try:
        tokens = parser.exhaust_lexer()
    except UnexpectedInput:
        return None
    accepted: set[str] = parser.accepts()  # type: ignore[no-untyped-call]  # lark does not annotate it
    return Expected(frozenset(accepted), tuple((token.type, str(token)) for token in tokens))
