"""Names in tables and options: normalisation, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterable


def cell_name(text: object) -> str:
    """The normal form of a column's name: NFKC, without surrounding blanks."""
    return unicodedata.normalize("NFKC", str(text)).strip()


FORMULA = "=+-@\t\r"
"""Characters with which a spreadsheet takes a cell for a formula, which could run a program."""


def for_spreadsheets(label: str) -> str:
    """A label as it is written to CSV and TSV: with `'` before what a spreadsheet would take for a formula.

    Numbers stay as they are; `from_spreadsheets` takes the sign away again.
    """
    return f"'{label}" if _like_formula(label) else label


def from_spreadsheets(label: str) -> str:
    """The label of a cell written by `for_spreadsheets`."""
    return label[1:] if label.startswith("'") and _like_formula(label[1:]) else label


def _like_formula(label: str) -> bool:
    """Whether a spreadsheet would take a cell for a formula, or `'` before it would be taken for ours."""
    bare = label.lstrip("'")
    if not bare.startswith(tuple(FORMULA)):
        return False
    try:
        float(bare)
    except ValueError:
        return True
    return bare != label


def similar(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate most similar to a misspelt name, almost ignoring upper and lower case; None if none is similar."""
    pool = {candidate.casefold(): candidate for candidate in candidates}
    close = difflib.get_close_matches(name.casefold(), pool, n=1, cutoff=0.7)
    return pool[close[0]] if close else None
