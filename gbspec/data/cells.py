"""Converts cells to numbers and labels, with missing values, and reports cells that are not numbers."""

from __future__ import annotations

import re
from hashlib import sha256

import numpy as np
import polars as pl
from numpy.typing import NDArray

from gbspec.arrays import Array, Mask
from gbspec.data.names import from_spreadsheets, similar
from gbspec.data.sheet import Sheet, shown
from gbspec.diagnostics import Cell, Findings

MISSING = ("", "na", "n/a", "nan", "null", "none", "-", ".")
"""The texts for *not measured*, besides the empty cell; upper and lower case are equivalent."""
BELOW = ("loq", "lloq", "lod", "blq", "bloq", "blod", "bql", "bdl", "nd", "n.d", "n/d", "not detected", "below limit")
"""The usual words for a value below a limit of detection or quantification."""
LARGEST, SMALLEST = 1e100, 1e-100
"""Magnitudes between which squares and quotients of numbers neither overflow nor vanish."""
OTHER_UNIT = "choose a unit in which its values are of moderate size"


def numbers(sheet: Sheet, name: str, findings: Findings, limits: bool = False) -> Array:
    """A column as float64 [n], NaN where the cell is empty or a word of `MISSING`; `limits`: its cells may be limits.

    Reports cells that are not numbers (GB712), infinite ones (GB713), columns of another kind (GB730), and numbers that
    are too large or too small to compute with (GB731).
    """
    series = sheet.columns[name]
    if series.dtype == pl.Null:
        return np.full(len(series), np.nan)
    if series.dtype in (pl.String, pl.Categorical):
        values, missing, texts = _from_text(series.cast(pl.String), sheet.decimal_comma)
    elif series.dtype.is_numeric():
        values = series.cast(pl.Float64).fill_null(float("nan")).to_numpy().astype(np.float64)
        missing, texts = np.isnan(values), None
    else:
        findings.error(
            "GB730",
            f"column `{name}` holds {str(series.dtype.base_type()).lower()} values where numbers are expected",
            Cell(sheet.path, None, name),
            help="write values as numbers, and times as those since the start, in the model's unit of time"
            if series.dtype.is_temporal()
            else "",
        )
        return np.full(len(series), np.nan)
    bad = np.flatnonzero(np.isnan(values) & ~missing)
    infinite = np.flatnonzero(np.isinf(values))
    _report_text(sheet, name, bad, texts, findings, limits)
    for i, notes in shown(infinite, "cells"):
        row = int(sheet.rows[i])
        findings.error(
            "GB713",
            f"`{name}` is infinite in row {row}",
            Cell(sheet.path, row, name),
            help="leave the cell empty where nothing was measured",
            notes=notes,
        )
    values[infinite] = np.nan
    _magnitudes(sheet, name, values, findings)
    return values


def _magnitudes(sheet: Sheet, name: str, values: Array, findings: Findings) -> None:
    """Reports numbers that are too large, or a column that is too small, to compute with (GB731)."""
    size = np.abs(values)
    huge = np.flatnonzero(size > LARGEST)
    for i, notes in shown(huge, "cells"):
        row = int(sheet.rows[i])
        message = f"`{name}` is {values[i]:g} in row {row}: above {LARGEST:g} computations overflow"
        findings.error("GB731", message, Cell(sheet.path, row, name), help=OTHER_UNIT, notes=notes)
    values[huge] = np.nan
    there = np.flatnonzero(size > 0)
    if len(there) and size[there].max() < SMALLEST:
        row = int(sheet.rows[there[0]])
        message = f"`{name}` is {values[there[0]]:g} in row {row}, and nowhere larger than {SMALLEST:g}"
        findings.error("GB731", message, Cell(sheet.path, row, name), help=OTHER_UNIT)


def _from_text(series: pl.Series, decimal_comma: bool) -> tuple[Array, Mask, pl.Series]:
    """The values, a mask of cells marked as not measured, and the texts without surrounding blanks."""
    texts = series.fill_null("").str.strip_chars()
    missing = texts.str.to_lowercase().is_in(list(MISSING)).to_numpy()
    plain = texts.str.replace(r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$", "${1}.${2}") if decimal_comma else texts
    values = plain.cast(pl.Float64, strict=False).fill_null(float("nan")).to_numpy().astype(np.float64)
    return values, missing, texts


def _report_text(
    sheet: Sheet, name: str, bad: NDArray[np.intp], texts: pl.Series | None, findings: Findings, limits: bool
) -> None:
    """Reports cells that are not numbers, with a guess at the intended number."""
    for i, notes in shown(bad, "cells"):
        text = "" if texts is None else str(texts[i])
        row = int(sheet.rows[i])
        short = text if len(text) <= 40 else text[:37] + "…"
        findings.error(
            "GB712",
            f"`{short}` in row {row} of column `{name}` is not a number",
            Cell(sheet.path, row, name),
            help=_meant(text, limits),
            notes=notes,
        )


def _meant(text: str, limits: bool) -> str:
    """A help line for a text that is not a number."""
    if re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", text):
        return f"write a point as the decimal sign: `{text.replace(',', '.')}`"
    if re.fullmatch(r"[-+]?\d{1,3}([,' ]\d{3})+(\.\d+)?", text):
        return "write numbers without a separator of thousands"
    if re.match(r"[<>≤≥]", text):
        return "a value below or above a limit was not measured: leave the cell empty"
    if re.match(r"\d{4}-\d{1,2}-\d{1,2}|\d{1,2}[./]\d{1,2}[./]\d{2,4}|\d{1,2}:\d{2}", text):
        return "a date or a time of day: write the time since the start as a number, in the model's unit of time"
    if match := re.match(r"[-+]?[\d.]+([eE][-+]?\d+)?", text):
        return f"keep only the number, `{match.group()}`, and put its unit into the model"
    if limits and text.lower().strip(" .") in BELOW:
        return "write `<` and the limit as a number (`<0.05`: a censored value); empty means that nothing was measured"
    return "leave the cell empty where nothing was measured"


def labels(sheet: Sheet, name: str, findings: Findings) -> tuple[list[str], NDArray[np.int64]]:
    """A column of labels: the distinct ones in the order of their first rows, and each row's index into them [n].

    Whole numbers are written without a fraction (`1` for 1.0), so that labels do not depend on the file format.
    Reports rows without a label (GB718).
    """
    series = sheet.columns[name]
    if not _named(sheet, name, "names of trajectories", findings):
        return [""], np.zeros(len(series), dtype=np.int64)
    texts = _texts(series)
    if texts.str.starts_with("'").any():
        texts = pl.Series([from_spreadsheets(text) for text in texts], dtype=pl.String)
    empty = np.flatnonzero((texts == "").to_numpy())
    for i, notes in shown(empty, "rows"):
        row = int(sheet.rows[i])
        findings.error(
            "GB718",
            f"row {row} has no label of a trajectory",
            Cell(sheet.path, row, name),
            help=f"fill `{name}` in every row, or leave the column out if there is only one trajectory",
            notes=notes,
        )
    return coded(texts)


def _named(sheet: Sheet, name: str, expected: str, findings: Findings) -> bool:
    """Whether a column can hold names; another kind of column is reported (GB730)."""
    kind = sheet.columns[name].dtype
    if kind.is_nested() or kind in (pl.Binary, pl.Object):
        message = f"column `{name}` holds {str(kind).lower()} values where {expected} are expected"
        findings.error("GB730", message, Cell(sheet.path, None, name), help="write them as texts or whole numbers")
        return False
    return True


def pairs(sheet: Sheet, first: str, second: str) -> list[tuple[str, str]]:
    """The different pairs of texts in two columns of labels, in the order in which they first occur; without those of
    which one is empty, and none where a column cannot hold names."""
    columns = [sheet.columns[name] for name in (first, second)]
    if any(c.dtype.is_nested() or c.dtype in (pl.Binary, pl.Object) for c in columns):
        return []
    frame = pl.DataFrame({"first": _texts(columns[0]), "second": _texts(columns[1])}).unique(maintain_order=True)
    return [(one, other) for one, other in frame.iter_rows() if one and other]


def _texts(series: pl.Series) -> pl.Series:
    """A column as texts without surrounding blanks; whole numbers without a fraction."""
    if series.dtype.is_float():
        whole = series.is_finite() & (series == series.round(0))
        whole_text = series.cast(pl.Int64, strict=False).cast(pl.String)
        frame = pl.DataFrame({"whole": whole, "whole_text": whole_text, "text": series.cast(pl.String)})
        series = frame.select(pl.when("whole").then("whole_text").otherwise("text")).to_series()
    return series.cast(pl.String).fill_null("").str.strip_chars()


def categories(sheet: Sheet, name: str, known: tuple[str, ...], findings: Findings, rows: Mask | None = None) -> Array:
    """The numbers of the categories in a column [n], NaN where a cell is empty or not among `rows`.

    Reports cells with another text (GB733), and columns of another kind (GB730).
    """
    if not _named(sheet, name, "categories", findings):
        return np.full(len(sheet.columns[name]), np.nan)
    texts = _texts(sheet.columns[name])
    if texts.str.starts_with("'").any():
        texts = pl.Series([text if text in known else from_spreadsheets(text) for text in texts], dtype=pl.String)
    numbered = texts.replace_strict(list(known), list(range(len(known))), default=None, return_dtype=pl.Float64)
    values = numbered.fill_null(float("nan")).to_numpy().astype(np.float64)
    missing = texts.str.to_lowercase().is_in(list(MISSING)).to_numpy()
    wanted = np.ones(len(values), dtype=bool) if rows is None else rows
    for i, notes in shown(np.flatnonzero(np.isnan(values) & ~missing & wanted), "cells"):
        row, text = int(sheet.rows[i]), str(texts[int(i)])
        meant = similar(text, list(known))
        findings.error(
            "GB733",
            f"`{text[:40]}` in row {row} of column `{name}` is none of the model's categories",
            Cell(sheet.path, row, name),
            help=f"is `{meant}` meant?" if meant else "they are " + ", ".join(f"`{one}`" for one in known),
            notes=notes,
        )
    return np.where(wanted, values, np.nan)


def numbered(sheet: Sheet, name: str, findings: Findings) -> Array:
    """A column of groups' labels as numbers [n]: numbers as they are, other texts by a number of their own, which is
    the same in every table (the first 48 bits of the SHA-256 digest); NaN where a cell is empty."""
    series = sheet.columns[name]
    if series.dtype not in (pl.String, pl.Categorical):
        return numbers(sheet, name, findings)
    values, missing, texts = _from_text(series.cast(pl.String), sheet.decimal_comma)
    words = np.isnan(values) & ~missing
    different = {text: int(sha256(text.encode()).hexdigest()[:12], 16) for text in set(texts.filter(words))}
    values[words] = [different[text] for text in texts.filter(words)]
    return values


def coded(texts: pl.Series) -> tuple[list[str], NDArray[np.int64]]:
    """The distinct texts in the order in which they first occur, and each one's index into them [n]."""
    if not len(texts):
        return [], np.zeros(0, dtype=np.int64)
    ranks = texts.rank("dense").to_numpy().astype(np.int64) - 1
    _, first = np.unique(ranks, return_index=True)
    order = np.argsort(first, kind="stable")
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    return [str(texts[int(i)]) for i in first[order]], position[ranks].astype(np.int64)
