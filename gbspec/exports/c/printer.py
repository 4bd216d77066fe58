"""Expressions as plain C99 over doubles, and the helper functions that they may call."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

import sympy

from gbspec.backends import CPrinter
from gbspec.ir import Lookup

ATOM = 5
WORDS = {
    "maximum": "gb_max",
    "minimum": "gb_min",
    "abs": "fabs",
    "sign": "gb_sign",
    "softplus": "gb_softplus",
    "logistic": "gb_logistic",
    "power": "pow",
}
"""Functions that C names otherwise than the arithmetic; the others have C's names."""

HELPERS = {
    "gb_max": "static double gb_max(double a, double b) { return a > b || a != a ? a : b; }",
    "gb_min": "static double gb_min(double a, double b) { return a < b || a != a ? a : b; }",
    "gb_sign": "static double gb_sign(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x; }",
    "gb_softplus": "static double gb_softplus(double x) { return x > 40.0 ? x : log1p(exp(x)); }",
    "gb_logistic": "static double gb_logistic(double x) { return 1.0 / (1.0 + exp(-x)); }",
    "gb_along": "/* A slope times a direction; an infinite slope counts nothing where nothing changes. */\n"
    "static double gb_along(double slope, double d) { return d == 0.0 ? 0.0 : slope * d; }",
}
"""Only those that a text uses are written: an unused static function is a warning."""

WORDS_OF_C = """
auto break case char const continue default do double else enum extern float for goto if inline int long
register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
asm bool true false near far NULL INFINITY NAN errno linux unix
"""
RESERVED = frozenset(WORDS_OF_C.split())
"""Words that a member or parameter cannot have for a name."""


class PlainC(CPrinter):
    """Prints C without the kernel's macros."""

    def call(self, function: str, *arguments: str) -> str:
        """`exp(x)`, `gb_max(a, b)`."""
        text = super().call(function, *arguments)
        if not text.startswith("f_"):
            return text
        return f"{WORDS.get(function, function)}({', '.join(arguments)})"

    def lookup(self, node: Lookup) -> str:
        """`table_12ab34cd(x, 0)`."""
        return super().lookup(node).removeprefix("R(").removesuffix(")")

    def integer(self, value: int) -> str:
        """`2.0`."""
        return f"{value}.0"

    def _number(self, node: sympy.Expr) -> tuple[str, int]:
        text, level = super()._number(node)
        if text.startswith("R("):
            text, level = text[2:-1], ATOM
        return (f"({text})", ATOM) if "/" in text or text.startswith("-") else (text, level)

    def constant(self, name: str, value: sympy.Expr) -> str:
        """Pi as a number; `INFINITY` and `NAN` of math.h."""
        return repr(float(sympy.pi)) if name == "pi" else super().constant(name, value)


def helpers(text: str) -> list[str]:
    """The helper functions that a text calls."""
    return [body for name, body in HELPERS.items() if re.search(rf"\b{name}\(", text)]


def number(value: float) -> str:
    """A double that C reads back as the same value."""
    return repr(float(value))


def ascii_text(text: str) -> str:
    """A text in ASCII that cannot end a comment."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "replace").decode()
    return " ".join(plain.split()).replace("*/", "* /").replace("/*", "/ *")


def identifier(name: str) -> str:
    """The C identifier nearest to a name: Greek letters by their names, other characters as `_`."""
    parts = [_letters(c) for c in name]
    text = re.sub(r"_+", "_", "".join(parts)).strip("_") or "x"
    text = f"_{text}" if text[0].isdigit() else text
    return f"{text}_" if text in RESERVED else text


def _letters(character: str) -> str:
    if character.isascii():
        return character if character.isalnum() else "_"
    words = unicodedata.name(character, "").split()
    if words[:1] == ["GREEK"] and words[-2:-1] == ["LETTER"]:
        return words[-1].capitalize() if "CAPITAL" in words else words[-1].lower()
    plain = unicodedata.normalize("NFKD", character)[:1]
    return plain if plain.isascii() and plain.isalnum() else "_"


def distinct(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Identifiers of names in one scope; an underscore and a number distinguish equal ones."""
    used, found = {*taken}, []
    for name in names:
        base = text = identifier(name)
        count = 1
        while text in used:
            count += 1
            text = f"{base}_{count}"
        used.add(text)
        found.append(text)
    return found


def table(kind: str, name: str, values: Iterable[str], width: int = 118) -> list[str]:
    """`static const double NAME[n] = {...};` over lines of a readable length."""
    items = list(values)
    lines, line = [], ""
    for item in items:
        if line and len(line) + len(item) + 2 > width:
            lines.append(line.rstrip())
            line = ""
        line += f"{item}, "
    lines.append(line.rstrip().rstrip(","))
    head = f"static const {kind} {name}[{len(items)}] = {{"
    if len(lines) == 1 and len(head) + len(lines[0]) < width:
        return [f"{head}{lines[0]}}};"]
    return [head, *(f"    {text}" for text in lines), "};"]
