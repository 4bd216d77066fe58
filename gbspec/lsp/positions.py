"""Offsets in a text and positions as editors count them: lines from 0, columns in units of an encoding."""

from __future__ import annotations

from typing import Literal

from gbspec.diagnostics import Source, Span

Encoding = Literal["utf-8", "utf-16", "utf-32"]
Position = tuple[int, int]
"""A line and a column, both from 0; the column counts code units."""


def units(text: str, encoding: Encoding) -> int:
    """The number of code units of a text in the encoding (UTF-16: two for characters beyond the basic plane)."""
    match encoding:
        case "utf-32":
            return len(text)
        case "utf-16":
            return len(text) + sum(character > "\uffff" for character in text)
        case "utf-8":
            return len(text.encode("utf-8", "surrogatepass"))


def to_offset(source: Source, position: Position, encoding: Encoding = "utf-16") -> int:
    """The offset of a position; beyond a line's end it is that end, inside a character that character's start."""
    line, column = position
    if line < 0:
        return 0
    if line >= len(source.line_starts):
        return len(source.text)
    start, text = source.line_starts[line], source.line(line + 1)
    if text.isascii() or encoding == "utf-32":
        return start + max(0, min(column, len(text)))
    for index, character in enumerate(text):
        column -= units(character, encoding)
        if column < 0:
            return start + index
    return start + len(text)


def to_position(source: Source, offset: int, encoding: Encoding = "utf-16") -> Position:
    """The position of an offset (between 0 and the length of the text)."""
    line, column = source.line_column(offset)
    start = source.line_starts[line - 1]
    return line - 1, units(source.text[start : start + column - 1], encoding)


def to_range(span: Span, encoding: Encoding = "utf-16") -> tuple[Position, Position]:
    """Beginning and end of a span."""
    return to_position(span.source, span.start, encoding), to_position(span.source, span.end, encoding)
