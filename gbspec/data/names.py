"""Names in tables and options: normalisation, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
import unicodedata
from collections.abc import Iterable


def cell_name(text: object) -> str:
    """The normal form of a column's name: NFKC, without surrounding blanks."""
    return unicodedata.normalize("NFKC", str(text)).strip()


def similar(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate most similar to a misspelt name, almost ignoring upper and lower case; None if none is similar."""
    pool = {candidate.casefold(): candidate for candidate in candidates}
    close = difflib.get_close_matches(name.casefold(), pool, n=1, cutoff=0.7)
    return pool[close[0]] if close else None
