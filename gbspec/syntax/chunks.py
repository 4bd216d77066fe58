"""Splits a file into statements: where each begins and ends, its comments, and its continuation lines.

A statement starts in the first column; an indented line continues it, and so does a line that begins with `)` or `]`;
blank and comment lines never end a statement. Linear in the length of the text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from gbspec.diagnostics import Source, Span

_STRING_OR_COMMENT = re.compile(r'"[^"\n]*"|[“”„«»][^“”„«»"\n]*[“”„«»"]|"[^\n]*|#[^\n]*')
_INDENT = re.compile(r"[ \t\u00a0\u2000-\u200a\u202f\u205f\u3000]+")


@dataclass(frozen=True)
class Comment:
    """A comment: `start` to `end` from its `#` to the end of its line; `own_line` if nothing precedes it."""

    start: int
    end: int
    own_line: bool


@dataclass(frozen=True)
class Chunk:
    """The text of one statement, `start` to `end` (the end of its last token or trailing comment).

    `lines` are the offsets of its lines' first tokens, without comment and blank lines; `indented` says
    whether it begins with an indentation that continues nothing.
    """

    source: Source
    start: int
    end: int
    lines: tuple[int, ...]
    comments: tuple[Comment, ...]
    indented: bool = False

    @property
    def span(self) -> Span:
        """From the first to the last token."""
        return Span(self.source, self.start, self.end)


@dataclass(frozen=True)
class Layout:
    """A file's statements, and the comments on separate lines between them."""

    chunks: tuple[Chunk, ...]
    comments: tuple[Comment, ...]


def split(source: Source) -> Layout:
    """Splits the text of a source into statements."""
    text = source.text
    chunks: list[Chunk] = []
    between: list[Comment] = []
    current: _Open | None = None
    position = 0
    while position < len(text):
        newline = text.find("\n", position)
        line_end = len(text) if newline < 0 else newline
        content, end, comment = _line(text, position, line_end)
        if content < end:
            indented = content > position
            if current is None or not (indented or text[content] in ")]"):
                if current is not None:
                    chunks.append(current.close(source))
                    between.extend(current.pending)
                current = _Open(content, indented)
            current.add(content, end, comment)
        elif comment is not None:
            (between if current is None else current.pending).append(comment)
        position = line_end + 1
    if current is not None:
        chunks.append(current.close(source))
        between.extend(current.pending)
    return Layout(tuple(chunks), tuple(between))


class _Open:
    """A statement that further lines may continue."""

    def __init__(self, start: int, indented: bool) -> None:
        self.start, self.end, self.indented = start, start, indented
        self.lines: list[int] = []
        self.comments: list[Comment] = []
        self.pending: list[Comment] = []  # own-line comments that belong to it only if another line follows

    def add(self, content: int, end: int, comment: Comment | None) -> None:
        self.comments.extend(self.pending)
        self.pending.clear()
        self.lines.append(content)
        self.end = end
        if comment is not None:
            self.comments.append(comment)

    def close(self, source: Source) -> Chunk:
        return Chunk(source, self.start, self.end, tuple(self.lines), tuple(self.comments), self.indented)


def _line(text: str, start: int, line_end: int) -> tuple[int, int, Comment | None]:
    """Where the line's content begins and ends (equal if it has none), and its comment."""
    indent = _INDENT.match(text, start, line_end)
    content = indent.end() if indent else start
    end, comment = line_end, None
    for found in _STRING_OR_COMMENT.finditer(text, content, line_end):
        if text[found.start()] == "#":
            end = found.start()
            comment = Comment(end, line_end, own_line=not text[content:end].strip())
    return content, content + len(text[content:end].rstrip()), comment
