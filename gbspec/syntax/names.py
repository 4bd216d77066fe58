"""Names as the language sees them: normal form, reserved words, and letters that look alike."""

from __future__ import annotations

import unicodedata
from functools import cache

FUNCTIONS: dict[str, int] = {
    **dict.fromkeys(("exp", "log", "log10", "sqrt", "sin", "cos", "tan", "tanh", "sinh", "cosh"), 1),
    **dict.fromkeys(("asin", "acos", "atan", "asinh", "acosh", "atanh", "abs", "sign", "floor", "ceil"), 1),
    **dict.fromkeys(("atan2", "mod", "min", "max"), 2),
}
"""The functions of the language and how many arguments each takes (`min` and `max`: at least that many)."""

REFUSED: frozenset[str] = frozenset({"pi", "if", "and", "or", "not", "net", "nn", *FUNCTIONS})
"""Names that cannot be declared."""

# Letters of other scripts, and digits, that look like the Latin letter on the right (from Unicode's table of confusable
# characters, reduced to those that appear in formulas).
_LOOK_ALIKE = {
    **dict(zip("ΑΒΕΖΗΙΚΜΝΟΡΤΥΧ", "ABEZHIKMNOPTYX", strict=True)),
    **dict(zip("αγικνορυχω", "ayikvopuxw", strict=True)),
    **dict(zip("АВЕЅІЈКМНОРСТУХЗ", "ABESIJKMHOPCTYX3", strict=True)),
    **dict(zip("аеѕіјорсухԁԛԝһ", "aesijopcyxdqwh", strict=True)),
    **dict(zip("ⅼоᴠᴢıɑɡℓ", "lovziagl", strict=True)),
    "0": "O",
    "1": "l",
    "µ": "u",
    "μ": "u",
}


def normalise(text: str) -> str:
    """The normal form (NFKC) under which names are compared."""
    return text if text.isascii() else unicodedata.normalize("NFKC", text)


def is_name(text: str) -> bool:
    """Whether a text is a well-formed name: a Unicode identifier without the middle dot."""
    return text.isidentifier() and "·" not in text and "·" not in normalise(text)


@cache
def skeleton(name: str) -> str:
    """The appearance of a name: equal for names that a reader cannot tell apart."""
    decomposed = unicodedata.normalize("NFD", normalise(name))
    return "".join(_LOOK_ALIKE.get(letter, letter) for letter in decomposed)


def looks_like(first: str, second: str) -> bool:
    """Whether two different names look the same, e.g. by a Greek omicron or a Cyrillic `а` among Latin letters."""
    return normalise(first) != normalise(second) and skeleton(first) == skeleton(second)


def explain_look_alike(written: str, meant: str) -> str:
    """A sentence on which letters of `written` differ from its look-alike `meant`; empty if they do not look alike."""
    written, meant = normalise(written), normalise(meant)
    if not looks_like(written, meant):
        return ""
    if len(written) != len(meant):
        return f"`{written}` and `{meant}` look alike but have different letters"
    pairs = [(a, b) for a, b in zip(written, meant, strict=True) if a != b]
    said = "; ".join(f"`{a}` is {_letter(a)}, `{b}` is {_letter(b)}" for a, b in dict.fromkeys(pairs))
    return f"`{written}` and `{meant}` look alike but differ: {said}"


def _letter(character: str) -> str:
    return "a " + unicodedata.name(character, f"character U+{ord(character):04X}").lower()
