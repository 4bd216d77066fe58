"""Tables in C: their places and coefficients as constants, and the functions that search and evaluate."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gbspec.ir import Curve, Table

_SEARCH = """\
/* Tables: the piece of x among n increasing places, and a polynomial of a distance, or its derivative. */
static int table_piece(const double *places, int n, double x) {
    int low = 0, high = n - 1;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (x < places[middle]) high = middle;
        else low = middle;
    }
    return low;
}

static double table_polynomial(const double *c, int powers, int order, double step) {
    double value = 0.0, factor;
    int power, i;
    for (power = powers - 1; power >= order; power--) {
        factor = 1.0;
        for (i = 0; i < order; i++) factor *= power - i;
        value = value * step + factor * c[power];
    }
    return value;
}

static double table_within(const double *places, int n, double x) {
    return x < places[0] ? places[0] : x > places[n - 1] ? places[n - 1] : x;
}"""


def table_function(curve: Curve) -> str:
    """The name of a table's function in C: by its content, since a name may have any letters."""
    return f"table_{curve.digest[:12]}"


def table_functions(tables: Iterable[Table]) -> list[str]:
    """The functions of all tables; `double` in every precision."""
    curves = {table.curve.digest: table.curve for table in tables}
    if not curves:
        return []
    return [_SEARCH, *("\n".join(_function(curve)) for curve in curves.values()), ""]


def _function(curve: Curve) -> list[str]:
    sides = "xy"[: len(curve.knots)]
    powers = curve.coefficients.shape[-1]
    sizes = [len(places) for places in curve.knots]
    head = ", ".join([*(f"double {x}" for x in sides), *(f"int order_{x}" for x in sides)])
    beyond = [f"{x} < {x}s[0] || {x} > {x}s[{n - 1}]" for x, n in zip(sides, sizes, strict=True)]
    lines = ["", f"static double {table_function(curve)}({head}) {{"]
    for x, places in zip(sides, curve.knots, strict=True):
        lines += _numbers(f"{x}s", places)
    lines += _numbers("c", curve.coefficients.ravel().tolist())
    lines += [
        f"    int {', '.join(f'at_{x}' for x in sides)};",
        *(["    double rows[4];", "    int i;"] * (len(sides) - 1)),
    ]
    if curve.outside == "error":
        within = " && ".join(f"!order_{x}" for x in sides)
        lines.append(f"    if ({within} && ({' || '.join(beyond)})) return NAN;")
    lines += [f"    if (order_{x} && ({test})) return 0.0;" for x, test in zip(sides, beyond, strict=True)]
    for x, n in zip(sides, sizes, strict=True):
        lines += [f"    {x} = table_within({x}s, {n}, {x});", f"    at_{x} = table_piece({x}s, {n}, {x});"]
    if len(sides) == 1:
        lines.append(f"    return table_polynomial(c + {powers}*at_x, {powers}, order_x, x - xs[at_x]);")
        return [*lines, "}"]
    block = f"{powers * powers}*(at_x*{sizes[1] - 1} + at_y)"
    lines += [
        f"    for (i = 0; i < {powers}; i++)",
        f"        rows[i] = table_polynomial(c + {block} + {powers}*i, {powers}, order_y, y - ys[at_y]);",
        f"    return table_polynomial(rows, {powers}, order_x, x - xs[at_x]);",
    ]
    return [*lines, "}"]


def _numbers(name: str, values: Sequence[float]) -> list[str]:
    """`static const double NAME[n] = {...};` over lines of a readable length."""
    lines, line = [], "       "
    for value in values:
        text = f" {value!r},"
        if len(line) + len(text) > 118:
            lines.append(line)
            line = "       "
        line += text
    return [f"    static const double {name}[{len(values)}] = {{", *lines, line.rstrip(","), "    };"]
