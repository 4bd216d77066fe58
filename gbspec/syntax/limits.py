"""The largest model that is read; a larger one is refused at once, before its text costs time and memory.

The limits are far above what a person writes, and keep every refusal within seconds (docs/limits.md).
"""

from __future__ import annotations

import re

from gbspec.diagnostics import Cell, Diagnostic, Source

MOST_BYTES = 2_000_000
"""The size of a model file."""
MOST_SIGNS = 150_000
"""The words, numbers and signs of a model, those in comments included; parsing takes some 20 µs for each."""
LONGEST_WORD = 1_000
"""The characters of one word or number."""
MOST_STATEMENTS = 10_000
"""The statements of a model, with those that it extends."""
MOST_WRITTEN_OUT = 20_000
"""The statements of a model with one for each element of an array."""
MOST_PARTS = 500_000
"""The names, numbers and operations of an array model with its statements written out for each element."""
MOST_ERRORS = 200
"""The wrong statements after which a file is not read on."""

_SIGN = re.compile(r"\w+|[^\w\s]")
_LONG = re.compile(rf"\w{{{LONGEST_WORD + 1},}}")


def too_large(source: Source, before: int = 0) -> Diagnostic | None:
    """The diagnostic for a text that is too large to be parsed; `before` counts the signs of those that extend it."""
    if len(source.text) > MOST_BYTES:
        return refused(source.path, f"this model has {len(source.text):,} characters; at most {MOST_BYTES:,} are read")
    found = signs(source) + before
    if found > MOST_SIGNS:
        return refused(source.path, f"this model has {found:,} words and signs; at most {MOST_SIGNS:,} are read")
    long = _LONG.search(source.text)
    if long is not None:
        line, _ = source.line_column(long.start())
        what = f"a word in line {line} has {len(long[0]):,} characters; at most {LONGEST_WORD:,} are read"
        return refused(source.path, what)
    return None


def signs(source: Source) -> int:
    """The number of words, numbers and other signs of a text."""
    return sum(1 for _ in _SIGN.finditer(source.text))


def refused(path: str, message: str) -> Diagnostic:
    """The diagnostic of a model beyond a limit."""
    help = "an array of states, a `function`, or data in a table says the same in less; is this file a model?"
    return Diagnostic("GB010", message, Cell(path), help=help)
