"""Names in tables and options: how they are compared, and which one a misspelt name means."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterable


def cell_name(text: object) -> str:
    """A column's name as it is compared: NFKC, without blanks around it."""
    return unicodedata.normalize("NFKC", str(text)).strip()


def similar(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate that a misspelt name most likely means; upper and lower case count little."""
    pool = {candidate.casefold(): candidate for candidate in candidates}
    close = difflib.get_close_matches(name.casefold(), pool, n=1, cutoff=0.7)
    return pool[close[0]] if close else None
