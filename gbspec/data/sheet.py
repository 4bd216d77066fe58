"""Reads a CSV, TSV or Parquet file into named columns, with the row numbers of a spreadsheet.

Text cells stay text here (their types are known later), so that a cell that is not a number is reported at its place.
All work over rows is vectorised.
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

from gbspec.data.lines import Lines, lines_of
from gbspec.data.names import cell_name
from gbspec.data.published import where_to_get
from gbspec.data.room import free_memory
from gbspec.diagnostics import Cell, Findings
from gbspec.files import read_bytes

SEPARATORS = {".csv": ",", ".tsv": "\t"}
PARQUET = frozenset({".parquet", ".pq"})
FORMATS = "CSV (.csv), TSV (.tsv) or Parquet (.parquet)"
SEPARATOR_NAMES = {",": "a comma", "\t": "a tab", ";": "a semicolon", "|": "a bar"}
MOST_COLUMNS = 10_000
SMALL = 100_000_000
"""Texts of fewer bytes are read without asking for the free memory."""
TIMES = 6
"""The memory that reading a text takes, in times of its bytes (docs/reliability.md, Limits)."""
LONGEST_LINE = 1_000_000
"""The bytes of one line of a text."""
MOST_ROWS = 20_000_000
"""The rows of a Parquet file, of which a small file may have any number."""
SHOWN = 5
"""The maximal number of diagnostics of one kind shown per column; the last one has the number of the others."""


@dataclass(frozen=True)
class Sheet:
    """The content of a table's file: `columns` of equal length, unique names, and `rows`, the row number of each.

    Rows are counted as in a spreadsheet: comments and blank rows count, and without them the header is row 1.
    Those of a table in memory, which has no row for the `header`, are counted from 0.
    `decimal_comma`: numbers may be written `0,5`.
    """

    path: str
    columns: dict[str, pl.Series]
    rows: NDArray[np.int64]
    sha256: str
    decimal_comma: bool = False
    header: int | None = 1

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the columns, in the file's order."""
        return tuple(self.columns)


def read_sheet(path: str | Path, findings: Findings) -> Sheet | None:
    """The file's columns; None (and at least one error in `findings`) if it cannot be read as a table."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SEPARATORS and suffix not in PARQUET:
        kind = f"`{path.suffix}` files" if path.suffix else "files without a file name extension"
        findings.error(
            "GB702",
            f"gbspec does not read {kind} as tables",
            Cell(str(path)),
            help=f"save the table as {FORMATS}; the file name extension determines the format",
        )
        return None
    if suffix in SEPARATORS and not _room_ok(path, findings):
        return None
    try:
        data = read_bytes(path)
    except OSError as error:
        reason = "there is no such file" if isinstance(error, FileNotFoundError) else (error.strerror or str(error))
        advice = where_to_get(path) if isinstance(error, FileNotFoundError) else ""
        findings.error("GB701", f"cannot read the table `{path}`: {reason}", Cell(str(path)), help=advice)
        return None
    sha256 = hashlib.sha256(data).hexdigest()
    if suffix in PARQUET:
        return _parquet(str(path), data, sha256, findings)
    text = [data]
    del data  # what is not needed any more is freed at once: a table may take most of the memory
    return _delimited(str(path), text, SEPARATORS[suffix], sha256, findings)


# ---------------------------------------------------------------------------------------------------------- text


def _room_ok(path: Path, findings: Findings) -> bool:
    """Whether the memory suffices for a large text, as far as that is known."""
    size = path.stat().st_size if path.is_file() else 0
    free = free_memory() if size > SMALL else None
    if free is None or TIMES * size <= free:
        return True
    need = f"reading it takes about {TIMES * size / 1e9:.3g} GB of memory"
    findings.error(
        "GB732",
        f"the table has {size / 1e9:.3g} GB: {need}, and {free / 1e9:.3g} GB are free",
        Cell(str(path)),
        help="keep fewer rows (every tenth, or fewer trajectories) and only the columns that the model names, or use a "
        "machine with more memory",
    )
    return False


def _delimited(path: str, text: list[bytes], separator: str, sha256: str, findings: Findings) -> Sheet | None:
    """Reads a CSV or TSV file, whose text is taken out of `text`. With semicolons as separators, decimal commas are
    allowed."""
    clean = _utf8(path, text.pop(), findings)
    if clean is None:
        return None
    if separator == "," and _by_semicolons(clean):
        separator = ";"
    if not _lines_ok(path, clean, findings):
        return None
    records = lines_of(clean, separator)
    del clean
    if records is None:
        findings.error("GB709", "a quote is opened and never closed", Cell(path), help='quotes come in pairs: "…"')
        return None
    if not _width_ok(path, records, findings):
        return None
    if not len(records.rows):
        findings.error("GB704", "the table is empty", Cell(path), help="its first row names the columns")
        return None
    try:
        header = next(csv.reader(io.StringIO(records.header.decode()), delimiter=separator))
    except csv.Error:
        _too_large(path, 1, "a column's name has more than 131,072 characters", findings)
        return None
    names = [cell_name(name) for name in header]
    if not _header_ok(path, names, separator, findings) or not _same_width(path, records, len(names), findings):
        return None
    rows = records.rows[1:]
    if not len(rows):
        findings.error("GB704", "the table has a header and no rows", Cell(path, 1), help="each row is one time")
        return None
    try:
        frame = _cells(records.body, separator, len(names))
    except pl.exceptions.PolarsError:
        frame = pl.DataFrame()
    if frame.shape != (len(rows), len(names)):
        findings.error(
            "GB709",
            "the table cannot be read: its quotes are unbalanced",
            Cell(path),
            help='a quoted cell begins and ends with `"`, and has `""` for each quote inside',
        )
        return None
    return Sheet(path, _named(names, frame.get_columns()), rows, sha256, decimal_comma=separator == ";")


def _cells(body: bytes, separator: str, width: int) -> pl.DataFrame:
    """The cells of a text without header, as texts.

    A text that begins like a compressed one (`x^`, as a label may) would be unpacked: a row before it prevents that.
    """
    before = b"0" + separator.encode() * (width - 1) + b"\n" if body.startswith(b"x") else b""
    columns = [str(i) for i in range(width)]
    frame = pl.read_csv(before + body, has_header=False, separator=separator, infer_schema=False, new_columns=columns)
    return frame[1:] if before else frame


def _by_semicolons(data: bytes) -> bool:
    """Whether semicolons separate the header's cells, as in spreadsheets of locales with decimal commas."""
    header = next((line for line in data.splitlines() if line.strip() and not line.startswith(b"#")), b"")
    return b";" in header and b"," not in header


def _utf8(path: str, data: bytes, findings: Findings) -> bytes | None:
    """The text without byte order mark and with LF line endings; None if it is not UTF-8."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        findings.error(
            "GB703", "the table is written in UTF-16", Cell(path, 1), help="save it as UTF-8 (`CSV UTF-8` in Excel)"
        )
        return None
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        findings.error(
            "GB703",
            f"row {row} contains a byte that is not UTF-8 (0x{data[error.start]:02x})",
            Cell(path, row),
            help="save the table as UTF-8 (`CSV UTF-8` in Excel)",
        )
        return None
    if b"\0" in data:
        row = data.count(b"\n", 0, data.index(b"\0")) + 1
        findings.error("GB703", f"row {row} contains a zero byte: this is not a text file", Cell(path, row))
        return None
    return data


def _lines_ok(path: str, data: bytes, findings: Findings) -> bool:
    """Whether no line is too long, before anything is computed for every character."""
    ends = np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == ord("\n"))
    lengths = np.diff(np.concatenate([[-1], ends, [len(data)]])) - 1
    long = np.flatnonzero(lengths > LONGEST_LINE)
    for i, notes in shown(long, "rows"):
        _too_large(
            path, i + 1, f"row {i + 1} has {lengths[i]:,} bytes; at most {LONGEST_LINE:,} are read", findings, notes
        )
    return not len(long)


def _width_ok(path: str, records: Lines, findings: Findings) -> bool:
    """Whether the header has no more columns than are read."""
    width = int(records.widths[0]) if len(records.widths) else 0
    if width > MOST_COLUMNS:
        row = int(records.rows[0])
        _too_large(path, row, f"the table has {width:,} columns; at most {MOST_COLUMNS:,} are read", findings)
    return width <= MOST_COLUMNS


def _too_large(path: str, row: int | None, message: str, findings: Findings, notes: tuple[str, ...] = ()) -> None:
    help = "write the times below each other, one row for each, and a column only for what the model names"
    findings.error("GB732", message, Cell(path, row), help=help, notes=notes)


def _header_ok(path: str, names: list[str], separator: str, findings: Findings) -> bool:
    """Whether the first row can be a header; reports its errors."""
    before = len(findings.errors)
    if len(names) == 1:
        for other, what in SEPARATOR_NAMES.items():
            if other != separator and other in names[0]:
                findings.error(
                    "GB705",
                    f"the cells of this table seem to be separated by {what}, not by {SEPARATOR_NAMES[separator]}",
                    Cell(path, 1),
                    help="save it with commas as `.csv` or with tabs as `.tsv`, and with `.` as the decimal sign",
                )
                return False
    if all(_is_number(name) for name in names if name) and any(names):
        findings.error(
            "GB706", "the first row has numbers where names are expected", Cell(path, 1), help="name the columns"
        )
    unique(path, [name for name in names if name], findings)
    return len(findings.errors) == before


def unique(path: str, names: list[str], findings: Findings) -> None:
    """Reports the names that several columns have."""
    counts = Counter(names)
    again = sorted(name for name, count in counts.items() if count > 1)
    for i, notes in shown(range(len(again)), "names"):
        findings.error(
            "GB707",
            f"{counts[again[i]]} columns are named `{again[i]}`",
            Cell(path, 1, again[i]),
            help="give each column its own name (for replicates use the long layout)",
            notes=notes,
        )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _same_width(path: str, records: Lines, expected: int, findings: Findings) -> bool:
    """Whether every record has as many cells as the header; reports the first few others."""
    wrong = np.flatnonzero(records.widths != expected)
    for i, notes in shown(wrong, "rows"):
        count = int(records.widths[i])
        findings.error(
            "GB708",
            f"row {records.rows[i]} has {count} cell{'s' * (count != 1)}, the header has {expected}",
            Cell(path, int(records.rows[i])),
            help="a decimal comma, or an unquoted text with a comma, may have split a cell"
            if count > expected
            else "an empty cell still needs its separator",
            notes=notes,
        )
    return not len(wrong)


def shown(
    positions: Sequence[int] | NDArray[np.intp], what: str, most: int = SHOWN
) -> Iterator[tuple[int, tuple[str, ...]]]:
    """The first positions, each with the notes of its diagnostic; the last one's note has the number of the others."""
    for rank, position in enumerate(positions[:most], start=1):
        further = len(positions) - most
        some = what.removesuffix("s") if further == 1 else what
        yield int(position), (f"and {further:,} more such {some}",) if rank == most and further > 0 else ()


def _named(names: list[str], columns: list[pl.Series]) -> dict[str, pl.Series]:
    """The columns by name; nameless ones (such as an index column) get a generated name."""
    named: dict[str, pl.Series] = {}
    for number, (name, column) in enumerate(zip(names, columns, strict=True), start=1):
        named[name or f"column {number} (nameless)"] = column
    return named


# -------------------------------------------------------------------------------------------------------- parquet


def _parquet(path: str, data: bytes, sha256: str, findings: Findings) -> Sheet | None:
    """Reads a Parquet file; its first record counts as row 2, as if there were a header."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(io.BytesIO(data))
        height, width = int(file.metadata.num_rows), int(file.metadata.num_columns)
        if height > MOST_ROWS or width > MOST_COLUMNS:
            most = f"at most {MOST_ROWS:,} and {MOST_COLUMNS:,} are read"
            _too_large(path, None, f"the table has {height:,} rows and {width:,} columns; {most}", findings)
            return None
        # not by polars, which ends the whole process at some damaged files
        frame = pl.DataFrame(pl.from_arrow(file.read()))
    except (pa.ArrowException, pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else "it is damaged"
        findings.error("GB709", f"the file is not a Parquet table that can be read: {reason}", Cell(path))
        return None
    names = [cell_name(name) for name in frame.columns]
    before = len(findings.errors)
    unique(path, names, findings)
    if not names or not frame.height:
        findings.error("GB704", "the table is empty", Cell(path), help="each row is one time")
    if len(findings.errors) > before:
        return None
    rows = np.arange(2, frame.height + 2, dtype=np.int64)
    return Sheet(path, _named(names, frame.get_columns()), rows, sha256)
