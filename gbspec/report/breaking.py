"""Long titles of panels and axes in lines that fit beside each other; names are broken after an underscore."""

from __future__ import annotations

import re

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
    for word in text.split():
        between = " " if lines[-1] else ""
        for piece in _pieces(word, width):
            if len(lines[-1] + between + piece) <= width:
                lines[-1] += between + piece
            else:
                lines.append(piece)
            between = ""
    return "\n".join(lines)


def _pieces(word: str, width: int) -> list[str]:
    """Where a word that is too long for a line may be broken: after underscores, and where even these do not help."""
    if len(word) <= width:
        return [word]
    parts = re.findall(r"[^_]*_|[^_]+", word)
    return [part[at : at + width] for part in parts for at in range(0, len(part), width)]
