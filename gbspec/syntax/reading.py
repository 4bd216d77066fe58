"""Reading a user's text file: UTF-8 with or without a byte order mark, any line endings."""

from __future__ import annotations

import re
from pathlib import Path

from gbspec.diagnostics import Cell, Diagnostic, Source, Span, UserError
from gbspec.files import TooLargeError, read_bytes
from gbspec.syntax.limits import MOST_BYTES, refused

_NUMBER = re.compile(r"[-+]?\d+([.,]\d*)?([eE][-+]?\d+)?")
_TABLES = frozenset({".csv", ".tsv", ".parquet", ".pq", ".xlsx"})


def read_source(path: Path | str) -> Source:
    """Reads a `.gb` file; raises `UserError` (GB001 absent, GB002 unreadable, GB003 not UTF-8)."""
    path = Path(path)
    place = Cell(str(path))
    if path.suffix.lower() in _TABLES and path.is_file():  # parsed as a model, each of its rows would be an error
        raise UserError([_a_table(path)])
    try:
        data = read_bytes(path, MOST_BYTES)
    except TooLargeError:
        what = f"`{path}` is larger than {MOST_BYTES:,} bytes, and no model is"
        raise UserError([refused(str(path), what)]) from None
    except FileNotFoundError:
        raise UserError([Diagnostic("GB001", f"there is no file `{path}`", place, help=_nearest(path))]) from None
    except IsADirectoryError:
        message = f"`{path}` is a folder, not a file"
        raise UserError([Diagnostic("GB002", message, place, help="name a `.gb` file in it")]) from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        message = f"`{path}` cannot be read: {reason}"
        raise UserError([Diagnostic("GB002", message, place, help="check its name and its permissions")]) from None
    source = decode(str(path), data)
    if path.suffix.lower() != ".gb" and _has_rows(source.text):
        raise UserError([_a_table(path)])
    return source


def _a_table(path: Path) -> Diagnostic:
    """What is said of a table where a model belongs, as by `gbspec check`, which takes no table, or in their order."""
    known = path.suffix.lower() in _TABLES - {".xlsx"}
    saved = "" if known else ", saved as CSV (.csv), TSV (.tsv) or Parquet (.parquet)"
    named = path if known else "TABLE.csv"
    return Diagnostic(
        "GB002",
        f"`{path}` is a table of data, not a model",
        Cell(str(path)),
        help="`gbspec check` takes models only; where a command takes a table, the `.gb` file comes before it"
        f"{saved}: `gbspec train MODEL.gb {named} -o RUN` names errors of a table before it fits",
    )


def _has_rows(text: str) -> bool:
    """Whether a text begins as a table does, with a line of names and a line of as many cells, some of them numbers."""
    lines = [line.strip() for line in text.split("\n", 40)[:40] if line.strip()][:2]
    if len(lines) < 2 or lines[0].startswith(("#", "model ")):
        return False
    for separator in ("\t", ";", ","):
        names, cells = (line.split(separator) for line in lines)
        if 1 < len(names) == len(cells) and any(_NUMBER.fullmatch(cell.strip()) for cell in cells):
            return True
    return False


def decode(path: str, data: bytes) -> Source:
    """The decoded bytes of a file; raises `UserError` (GB003) if they are not UTF-8."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        message = f"`{path}` is saved as UTF-16, and gbspec reads UTF-8"
        raise UserError([Diagnostic("GB003", message, Cell(path), help="save it as UTF-8")])
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        source = Source(path, _lines(data.decode("utf-8", errors="replace")))
        at = len(_lines(data[: error.start].decode("utf-8")))
        message = f"this byte (0x{data[error.start]:02X}) is not UTF-8"
        help = "save the file as UTF-8; it may have been saved in an older encoding such as Latin-1"
        raise UserError([Diagnostic("GB003", message, Span(source, at, at + 1), help=help)]) from None
    return Source(path, _lines(text))


def _lines(text: str) -> str:
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def _nearest(path: Path) -> str:
    """A hint at a file of the folder with a similar name; empty if there is none."""
    from difflib import get_close_matches

    folder = path.parent
    if not folder.is_dir():
        return f"the folder `{folder}` does not exist"
    try:
        names = [entry.name for entry in folder.iterdir() if entry.suffix == ".gb"]
    except OSError:
        return ""
    close = get_close_matches(path.name, names, n=1) or get_close_matches(path.name + ".gb", names, n=1)
    return f"did you mean `{folder / close[0]}`?" if close else ""
