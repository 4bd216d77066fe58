"""Long titles of panels and axes in lines that fit beside each other, and names at the places of an axis cut short.

Names are broken after an underscore.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import takewhile

TITLE, LABEL, HEADING = 13.0, 15.0, 11.5
"""Characters per inch: of titles (8.5 pt, bold), of what an axis is called (9 pt), of headings (10 pt, bold)."""
LEAST = 8
"""The fewest characters of a line, in however small a panel."""


def broken(text: str, inches: float, density: float) -> str:
    """A text with line breaks, so that no line is longer than `inches` of `density` characters per inch."""
    width = max(LEAST, int(inches * density))
    if len(text) <= width:
        return text
    lines = [""]
    for word in _words(text, width):
        between = " " if lines[-1] else ""
        for piece in _pieces(word, width):
            if len(lines[-1] + between + piece) <= width:
                lines[-1] += between + piece
            else:
                lines.append(piece)
            between = ""
    return "\n".join(lines)


def cut(names: Sequence[str], most: int) -> list[str]:
    """Names of at most `most` characters: long ones lose their end, else what all of them begin with, else their
    middle, the first of these after which none of them look alike (or the last)."""
    common = "".join(first for first, *_ in takewhile(lambda signs: len(set(signs)) == 1, zip(*names, strict=False)))
    start = len(re.sub(r"[^\W_]+\Z", "", common))
    half = (most - 1) // 2

    def ways(name: str) -> tuple[str, str, str]:
        if len(name) <= most:
            return name, name, name
        rest = name[start:]
        rest = rest if len(rest) < most else rest[: most - 2] + "…"
        return name[: most - 1] + "…", f"…{rest}", f"{name[:half]}…{name[half + 1 - most :]}"

    found = [list(way) for way in zip(*map(ways, names), strict=True)]
    return next((way for way in found if len(set(way)) == len(set(names))), found[-1] if found else [])


def _words(text: str, width: int) -> list[str]:
    """What stands between spaces; `p = 0.012` is one word, if a line has room for it."""
    found: list[str] = []
    for word in re.findall(r"\S+(?:\s+=\s+\S+)*", text):
        found += [word] if len(word) <= width else word.split()
    return found


def _pieces(word: str, width: int) -> list[str]:
    """Where a word that is too long for a line may be broken: after underscores, and where even these do not help."""
    if len(word) <= width:
        return [word]
    parts = re.findall(r"[^_]*_|[^_]+", word)
    return [part[at : at + width] for part in parts for at in range(0, len(part), width)]
