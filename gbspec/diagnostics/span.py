"""Places in a user's text: a source file, a span of it, and a cell of a data table."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cached_property


@dataclass(frozen=True)
class Source:
    """A text that a user wrote: its path and its content (BOM removed, line endings normalised to LF)."""

    path: str
    text: str

    @cached_property
    def line_starts(self) -> tuple[int, ...]:
        """Offsets at which lines begin; the first is 0."""
        return (0, *(i + 1 for i, character in enumerate(self.text) if character == "\n"))

    def line_column(self, offset: int) -> tuple[int, int]:
        """Line and column of an offset, both counted from 1; columns count code points."""
        line = bisect_right(self.line_starts, offset)
        return line, offset - self.line_starts[line - 1] + 1

    def line(self, number: int) -> str:
        """The text of one line (counted from 1), without its line ending."""
        start = self.line_starts[number - 1]
        end = self.line_starts[number] - 1 if number < len(self.line_starts) else len(self.text)
        return self.text[start:end]

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


@dataclass(frozen=True)
class Span:
    """A half-open range of code points in a source."""

    source: Source = field(repr=False)
    start: int
    end: int

    @property
    def text(self) -> str:
        """The text of the span."""
        return self.source.text[self.start : self.end]

    def to(self, other: Span) -> Span:
        """The span from the beginning of this one to the end of the other."""
        return Span(self.source, min(self.start, other.start), max(self.end, other.end))

    @property
    def position(self) -> tuple[int, int, int, int]:
        """Line, column, end line, end column; all counted from 1, the end exclusive."""
        return (*self.source.line_column(self.start), *self.source.line_column(self.end))


@dataclass(frozen=True)
class Cell:
    """A place in a data table: the row as in a spreadsheet (row 1 is the header) and the column's name."""

    path: str
    row: int | None = None
    column: str | None = None


Place = Span | Cell | None
