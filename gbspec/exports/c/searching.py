"""The search for algebraic variables in C: the equations of each search, and the tables that the search reads."""

from __future__ import annotations

import math
from collections.abc import Iterable

from gbspec.backends import start_of
from gbspec.exports.c.printer import number, table
from gbspec.exports.c.straight import Place, Straight, function, unused
from gbspec.exports.programs import Programs
from gbspec.ir import Algebraic

GIVEN = ("p", "t", "x", "u")
HEAD = "const {0}_parameters *p, double t, const double *x, const double *u, const double *solved"
MOVED = HEAD + ", const {0}_parameters *dp, double dt, const double *dx, const double *du, const double *dsolved"


def searching(programs: Programs, prefix: str, place: Place, direction: Place, text: str) -> list[str]:
    """The C of all searches; `text` is that of `search.c`. Nothing for a model without algebraic variables."""
    searches = programs.searches
    if not searches:
        return []
    out, names = list[str](), [*GIVEN, "solved", "out"]
    for i, search in enumerate(searches):
        lines = Straight(search.residual, place).body("out")
        out += function(f"static void left_{i}({HEAD.format(prefix)}, double *out)", lines, unused(names, lines))
        lines = Straight(search.residual, place, direction).body("out")
        head = f"static void left_{i}_along({MOVED.format(prefix)}, double *out)"
        out += function(head, lines, unused([*names, "dp", "dt", "dx", "du", "dsolved"], lines))
    variables = [item for search in searches for item in search.variables]
    out += table("int", "FIRST", (str(search.first) for search in searches))
    out += table("int", "COUNT", (str(len(search.variables)) for search in searches))
    for name, values in (
        ("START", map(start_of, variables)),
        ("LOW", (_end(item, 0) for item in variables)),
        ("HIGH", (_end(item, 1) for item in variables)),
        ("SIZE", map(_size, variables)),
    ):
        out += table("double", name, _numbers(values))
    largest = max(len(search.variables) for search in searches)
    out += [f"enum {{ SEARCHES = {len(searches)}, LARGEST = {largest} }};", ""]
    plain, moved = "p, t, x, u, solved, out", "p, t, x, u, solved, dp, dt, dx, du, dsolved, out"
    text = text.replace("LEFT", _cases(len(searches), "", plain)).replace(
        "ALONG", _cases(len(searches), "_along", moved)
    )
    return [*out, *text.splitlines(), ""]


def _cases(count: int, suffix: str, arguments: str) -> str:
    return "\n".join(f"    case {i}: left_{i}{suffix}({arguments}); break;" for i in range(count))


def _end(item: Algebraic, which: int) -> float:
    if item.range is None:
        return (-math.inf, math.inf)[which]
    return (item.range.low, item.range.high)[which]


def _size(item: Algebraic) -> float:
    """The length of its range, else its start, else 1."""
    low, high = _end(item, 0), _end(item, 1)
    return high - low if math.isfinite(low) and math.isfinite(high) else abs(start_of(item)) or 1.0


def _numbers(values: Iterable[float]) -> list[str]:
    return [number(v) if math.isfinite(v) else ("HUGE_VAL" if v > 0 else "-HUGE_VAL") for v in values]
