"""Words and statements at a place in a text that may have errors, for an editor."""

from __future__ import annotations

import re

from gbspec.diagnostics import Source, Span
from gbspec.syntax.chunks import Chunk, split

_WORD = re.compile(r"[^\W\d]\w*")
_STRING = re.compile(r'"[^"\n]*("|$)', re.MULTILINE)


def inert(source: Source, offset: int) -> bool:
    """Whether an offset lies inside a string or a comment."""
    line = source.line_column(offset)[0]
    start = source.line_starts[line - 1]
    position = start
    while position < offset:
        character = source.text[position]
        if character == "#":
            return True
        if character == '"':
            found = _STRING.match(source.text, position)
            end = found.end() if found is not None else position + 1
            closed = found is not None and bool(found[1])
            if offset < end or (offset == end and not closed):
                return True
            position = end
        else:
            position += 1
    return False


def word_at(source: Source, offset: int) -> Span | None:
    """The word around an offset or ending there; None in a string, in a comment, and where there is no word."""
    line = source.line_column(offset)[0]
    start = source.line_starts[line - 1]
    for found in _WORD.finditer(source.line(line)):
        if start + found.start() <= offset <= start + found.end() and not inert(source, start + found.start()):
            return Span(source, start + found.start(), start + found.end())
    return None


def statement_before(source: Source, offset: int) -> str:
    """The beginning of the statement that a word at the offset would belong to, comments blanked; empty at its start.

    A place at the start of a line begins a statement; an indented one continues the statement above.
    """
    line = source.line_column(offset)[0]
    line_start = source.line_starts[line - 1]
    if line_start == offset:
        return ""
    before = source.text[line_start:offset]
    earlier = [chunk for chunk in split(source).chunks if chunk.start < offset]
    continues = before[0].isspace() or before[0] in ")]"
    if not earlier or (earlier[-1].start < line_start and not continues):
        return before
    return _blanked(earlier[-1], offset)


def _blanked(chunk: Chunk, end: int) -> str:
    text = chunk.source.text
    for comment in chunk.comments:
        text = text[: comment.start] + " " * (comment.end - comment.start) + text[comment.end :]
    return text[chunk.start : end]
