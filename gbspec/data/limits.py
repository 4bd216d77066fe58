"""Cells of channels that are limits: `<0.05`, `>100`, and the sides that a column `limit_NAME` gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.data.cells import numbers
from gbspec.data.sheet import Sheet, shown
from gbspec.diagnostics import Cell, Findings

Sides = NDArray[np.int8]
LIMIT = r"^\s*([<>≤≥])=?\s*([^<>=≤≥].*)$"
"""A limit: its sign and its number."""
WORDS = {"<": -1.0, "≤": -1.0, "below": -1.0, ">": 1.0, "≥": 1.0, "above": 1.0}
"""What a column `limit_NAME` may have in place of -1 and 1."""


def measured(sheet: Sheet, name: str, findings: Findings) -> tuple[Array, Sides]:
    """A column of a channel as numbers [n] (NaN where a cell is empty), and the sides of those that are limits."""
    series = sheet.columns[name]
    side = np.zeros(len(series), dtype=np.int8)
    if series.dtype not in (pl.String, pl.Categorical):
        return numbers(sheet, name, findings, limits=True), side
    texts = series.cast(pl.String).fill_null("")
    limit = texts.str.contains(LIMIT).to_numpy()
    if not limit.any():
        return numbers(sheet, name, findings, limits=True), side
    above = texts.str.strip_chars().str.contains("^[>≥]").to_numpy()
    side[limit] = np.where(above[limit], 1, -1)
    plain = replace(sheet, columns={**sheet.columns, name: texts.str.replace(LIMIT, "$2")})
    return numbers(plain, name, findings, limits=True), side


def sides(sheet: Sheet, name: str, findings: Findings) -> Sides:
    """The sides [n] of a column `limit_NAME`: -1 or `<`, 1 or `>`, 0 for empty cells. Reports others (GB764)."""
    series = sheet.columns[name]
    if series.dtype in (pl.String, pl.Categorical):
        texts = series.cast(pl.String).fill_null("").str.strip_chars().str.to_lowercase()
        words = texts.replace({word: f"{value:g}" for word, value in WORDS.items()})
        sheet = replace(sheet, columns={**sheet.columns, name: words})
    found = numbers(sheet, name, findings)
    wrong = np.flatnonzero(~np.isnan(found) & ~np.isin(found, (-1.0, 0.0, 1.0)))
    for i, notes in shown(wrong, "cells"):
        row = int(sheet.rows[i])
        findings.error(
            "GB764",
            f"`{name}` is {found[i]:g} in row {row}, which says of no value that it is a limit",
            Cell(sheet.path, row, name),
            help="write -1 (or `<`) where the value lies below the number beside it, 1 (or `>`) where above",
            notes=notes,
        )
    return np.nan_to_num(np.where(np.isin(found, (-1.0, 1.0)), found, 0.0)).astype(np.int8)
