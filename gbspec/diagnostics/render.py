"""Renders diagnostics as text and as JSON."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass

from gbspec.diagnostics.diagnostic import Diagnostic, Severity
from gbspec.diagnostics.span import Cell, Source, Span

_TAB = 4
_MAX_WIDTH = 140  # longer lines of the text are cut around the marks
_CONTEXT = 40  # how much of a cut line is kept before the mark
_COLORS = {"error": "1;31", "warning": "1;33", "gutter": "1;34", "bold": "1", "secondary": "1;34"}


@dataclass(frozen=True)
class _Mark:
    """A part of one line to be underlined."""

    line: int
    start: int  # columns from 0, in code points
    end: int
    text: str
    primary: bool


def render_text(diagnostics: Iterable[Diagnostic], color: bool = False) -> str:
    """All diagnostics as text, each with its excerpt, separated by empty lines; empty if there are none."""
    return "\n".join(_Renderer(diagnostic, color).render() for diagnostic in diagnostics)


def to_json(diagnostic: Diagnostic) -> dict[str, object]:
    """The diagnostic as plain data; lines and columns count from 1, the end is exclusive.

    A place in a table has its row as `line` and no column number; `cell` holds its row and the name of its column.
    """
    data: dict[str, object] = {
        "code": diagnostic.code,
        "severity": diagnostic.severity.value,
        "message": diagnostic.message,
        **_position(diagnostic.place),
        "labels": [{**_position(label.span), "text": label.text} for label in diagnostic.labels],
        "notes": list(diagnostic.notes),
        "help": diagnostic.help,
    }
    if isinstance(diagnostic.place, Cell) and diagnostic.place.row is not None:
        data["cell"] = {"row": diagnostic.place.row, "column": diagnostic.place.column}
    return data


def summary(diagnostics: Iterable[Diagnostic]) -> str:
    """The counts, as in `2 errors, 1 warning`; empty without diagnostics."""
    severities = [diagnostic.severity for diagnostic in diagnostics]
    counts = [(severities.count(kind), kind.value) for kind in (Severity.ERROR, Severity.WARNING)]
    return ", ".join(f"{count} {word}{'s' if count > 1 else ''}" for count, word in counts if count)


def _position(place: Span | Cell | None) -> dict[str, object]:
    names = ("line", "column", "end_line", "end_column")
    match place:
        case Span():
            return {"file": place.source.path, **dict(zip(names, place.position, strict=True))}
        case Cell():
            return {"file": place.path, "line": place.row, "column": None, "end_line": place.row, "end_column": None}
        case None:
            return {"file": None, **dict.fromkeys(names)}


class _Renderer:
    """The text of one diagnostic."""

    def __init__(self, diagnostic: Diagnostic, color: bool) -> None:
        self.diagnostic, self.color = diagnostic, color
        self.marks = _marks(diagnostic)
        lines = [mark.line for marks in self.marks.values() for mark in marks]
        self.margin = len(str(max(lines))) if lines else 1

    def render(self) -> str:
        found = self.diagnostic
        head = f"{found.severity.value}[{found.code}]"
        out = [self._paint(found.severity.value, head) + self._paint("bold", f": {printable(found.message)}")]
        match found.place:
            case Cell():
                out.append(f"{' ' * self.margin}{self._paint('gutter', '-->')} {_cell(found.place, found.label)}")
            case Span():
                for index, (source, marks) in enumerate(self.marks.items()):
                    out.extend(self._excerpt(source, marks, first=index == 0))
            case None:
                pass
        tail = [("note", note) for note in found.notes] + ([("help", found.help)] if found.help else [])
        if tail and isinstance(found.place, Span):
            out.append(self._gutter())
        for kind, text in tail:
            out.append(
                self._paint("gutter", f"{' ' * self.margin} = ") + self._paint("bold", kind) + f": {printable(text)}"
            )
        return "\n".join(line.rstrip() for line in out) + "\n"

    def _excerpt(self, source: Source, marks: list[_Mark], first: bool) -> list[str]:
        """One file's lines with their marks."""
        arrow = "-->" if first else ":::"
        shown = marks[0]  # in the diagnostic's own file, its own place
        place = f"{printable(source.path)}:{shown.line}:{shown.start + 1}"
        out = [f"{' ' * self.margin}{self._paint('gutter', arrow)} {place}", self._gutter()]
        previous: int | None = None
        for number in sorted({mark.line for mark in marks}):
            if previous is not None and number == previous + 2:
                out.append(self._gutter(previous + 1, _shown(source.line(previous + 1), 0, _MAX_WIDTH)))
            elif previous is not None and number > previous + 2:
                out.append(self._paint("gutter", "..."))
            here = sorted((mark for mark in marks if mark.line == number), key=lambda mark: mark.start)
            out.extend(self._marked_line(source.line(number), number, here))
            previous = number
        return out

    def _marked_line(self, text: str, number: int, marks: list[_Mark]) -> list[str]:
        """A line of the text and, below it, one line for each mark."""
        low, high = _window(text, marks)
        out = [self._gutter(number, _shown(text, low, high))]
        lead = 1 if low else 0
        for mark in marks:
            start, end = max(mark.start, low), min(max(mark.end, mark.start + 1), max(high, mark.start + 1))
            before = lead + display_width(text[low:start], lead)
            width = max(1, display_width(text[start:end], before)) if start < len(text) else 1
            sign, paint = ("^", self.diagnostic.severity.value) if mark.primary else ("-", "secondary")
            line = sign * width + (f" {printable(mark.text)}" if mark.text else "")
            out.append(self._gutter(text=" " * before + self._paint(paint, line)))
        return out

    def _gutter(self, number: int | None = None, text: str = "") -> str:
        label = "" if number is None else str(number)
        return self._paint("gutter", f"{label:>{self.margin}} |") + (f" {text}" if text else "")

    def _paint(self, kind: str, text: str) -> str:
        return f"\x1b[{_COLORS[kind]}m{text}\x1b[0m" if self.color else text


def _marks(diagnostic: Diagnostic) -> dict[Source, list[_Mark]]:
    """The parts to underline, by file, the diagnostic's own file first."""
    found: dict[Source, list[_Mark]] = {}
    if not isinstance(diagnostic.place, Span):
        return found
    labelled = [(diagnostic.place, diagnostic.label, True)]
    labelled += [(label.span, label.text, False) for label in diagnostic.labels]
    for span, text, primary in labelled:
        line, column, end_line, end_column = span.position
        end = end_column - 1 if end_line == line else len(span.source.line(line).rstrip())
        found.setdefault(span.source, []).append(_Mark(line, column - 1, max(end, column), text, primary))
    return found


def _cell(cell: Cell, label: str) -> str:
    parts = [f"row {cell.row}"] if cell.row is not None else []
    parts += [f'column "{printable(cell.column)}"'] if cell.column is not None else []
    place = printable(cell.path) + (": " + ", ".join(parts) if parts else "")
    return place + (f" ({printable(label)})" if label else "")


def _window(text: str, marks: list[_Mark]) -> tuple[int, int]:
    """The start and end of the visible part of a long line."""
    if len(text) <= _MAX_WIDTH:
        return 0, len(text)
    low = max(0, min(mark.start for mark in marks) - _CONTEXT)
    return low, min(len(text), low + _MAX_WIDTH)


def _shown(text: str, low: int, high: int) -> str:
    high = min(high, len(text))
    lead = "…" if low else ""
    return lead + _expand(text[low:high], len(lead)) + ("…" if high < len(text) else "")


def _expand(text: str, column: int) -> str:
    """The text with tabs as spaces and control characters replaced."""
    out = []
    for character in text:
        shown = " " * (_TAB - column % _TAB) if character == "\t" else printable(character)
        column += _width(shown)
        out.append(shown)
    return "".join(out)


def display_width(text: str, column: int) -> int:
    """The number of terminal columns of a text that begins at a given column."""
    return _width(_expand(text, column))


def _width(text: str) -> int:
    if text.isascii():
        return len(text)
    return sum(_character_width(character) for character in text)


def _character_width(character: str) -> int:
    if unicodedata.category(character) in ("Mn", "Me", "Cf"):
        return 0
    return 2 if unicodedata.east_asian_width(character) in ("W", "F") else 1


def printable(text: str) -> str:
    """The text with control and invisible formatting characters replaced, so that it cannot control a terminal."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        "\ufffd" if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") and c != "\n" else c for c in text
    )
