"""How results show themselves: in one line, as a data frame, and as a table in a notebook.

polars is imported when a frame is made, so that `import gbspec` stays light.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import polars as pl

MOST_ROWS = 20
"""The rows of a frame that a notebook shows."""


class Framed(Protocol):
    """A result that can be given as a data frame."""

    def to_frame(self) -> pl.DataFrame:
        """The result as a polars data frame; `.to_pandas()` of it is one of pandas."""


class Shown:
    """A result with a short `repr`; in a notebook its text and the first rows of its frame are shown."""

    def to_frame(self) -> pl.DataFrame:
        """The result as a polars data frame; `.to_pandas()` of it is one of pandas."""
        raise NotImplementedError

    def summary(self) -> str:
        """What the result is, in one line."""
        return str(self).partition("\n")[0]

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.summary()}>"


class Tabled(Shown):
    """A result that a notebook shows as a table."""

    def notes(self) -> Sequence[str]:
        """Lines below the table."""
        return ()

    def _repr_html_(self) -> str:
        return html(self.to_frame(), self.summary(), self.notes())


def counted(number: int, word: str, several: str = "") -> str:
    """A number with what it counts: `1 row`, `2 trajectories`; `several` is the plural where it is not regular."""
    regular = f"{word[:-1]}ies" if word.endswith("y") else f"{word}s"
    return f"{number:,} {word if number == 1 else several or regular}"


def of_rows(rows: Iterable[Mapping[str, object]]) -> pl.DataFrame:
    """A frame of rows by name; numbers are compared over all rows before a column has its type."""
    import polars as pl

    return pl.DataFrame(list(rows), infer_schema_length=None, nan_to_null=True)


def html(frame: pl.DataFrame, caption: str, notes: Sequence[str] = ()) -> str:
    """A table of HTML with a caption, the first rows of a frame, and lines below it."""
    parts = [f"<table><caption>{escape(caption)}</caption><thead><tr>"]
    parts += [f"<th>{escape(name)}</th>" for name in frame.columns]
    parts.append("</tr></thead><tbody>")
    for row in frame.head(MOST_ROWS).iter_rows():
        parts.append("<tr>" + "".join(f"<td>{escape(_cell(value))}</td>" for value in row) + "</tr>")
    parts.append("</tbody></table>")
    more = frame.height - MOST_ROWS
    lines = [*notes] + ([f"and {more:,} more rows, in `.to_frame()`"] if more > 0 else [])
    return "".join(parts) + "".join(f"<p>{escape(line)}</p>" for line in lines)


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
