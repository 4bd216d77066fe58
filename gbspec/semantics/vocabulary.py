"""The functions of the language, names from other languages, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable

from gbspec.syntax import FUNCTIONS, explain_look_alike, looks_like

CONSTANTS = {"pi": math.pi}

ACTIVATIONS = ("silu", "tanh", "softplus", "relu", "gelu", "sigmoid", "elu", "sin")
"""Activations of `mlp(...)`; the same as `gbspec.ir.model.Activation` (which this layer does not import)."""

FOREIGN = {
    "ln": "write `log`, the natural logarithm",
    "log2": "write `log(x)/log(2)`",
    "log1p": "write `log(1 + x)`",
    "expm1": "write `exp(x) - 1`",
    "lg": "write `log10`",
    "pow": "write `a^b`",
    "power": "write `a^b`",
    "sqr": "write `x^2`",
    "square": "write `x^2`",
    "cbrt": "write `x^(1/3)`",
    "tg": "write `tan`",
    "arcsin": "write `asin`",
    "arccos": "write `acos`",
    "arctan": "write `atan`",
    "arctan2": "write `atan2`",
    "fabs": "write `abs`",
    "sgn": "write `sign`",
    "ceiling": "write `ceil`",
    "round": "write `floor(x + 0.5)`",
    "int": "write `floor(x)`, or `sign(x)*floor(abs(x))` to round towards zero",
    "trunc": "write `sign(x)*floor(abs(x))`",
    "fmod": "write `mod(x, y)`, whose sign is that of y",
    "rem": "write `mod(x, y)`, whose sign is that of y",
    "modulo": "write `mod(x, y)`",
    "quotient": "write `floor(x/y)`",
    "maximum": "write `max`",
    "minimum": "write `min`",
    "where": "write `if(condition, a, b)`",
    "ifelse": "write `if(condition, a, b)`",
    "piecewise": "write `if(condition, a, b)`",
    "heaviside": "write `if(x > 0, 1, 0)`",
    "sigmoid": "write `1/(1 + exp(-x))`",
    "der": "a rate of change occurs only on the left side, as in `X' = …`",
    "diff": "a rate of change occurs only on the left side, as in `X' = …`",
    "e": "write `exp(1)`",
    "PI": "write `pi`",
    "Pi": "write `pi`",
    "π": "write `pi`",
    "dt": "a measured rate of change is written `X'`, in `observe`",
    **dict.fromkeys(("true", "True"), "write `1`: names have numbers as values"),
    **dict.fromkeys(("false", "False"), "write `0`: names have numbers as values"),
    "steady": "write `initial X steady`, without `=`, or `initial steady` for all states",
    "inf": "leave the bound out, or give a large number",
}
"""Names from other languages, and their equivalents here."""


def arity(function: str) -> tuple[int, int | None]:
    """Least and largest number of arguments of a function of the language (None: any number)."""
    return FUNCTIONS[function], None if function in ("min", "max") else FUNCTIONS[function]


def swapped(name: str, other: str) -> bool:
    """Whether two neighbouring characters exchanged make one name the other: a single slip, as `tahn` for `tanh`."""
    return name != other and any(
        name[:i] + name[i + 1] + name[i] + name[i + 2 :] == other for i in range(len(name) - 1)
    )


def suggestion(name: str, candidates: Iterable[str]) -> str:
    """A help line for an undeclared name: a look-alike, an equivalent, or the nearest spelling; else empty."""
    pool = sorted(set(candidates))
    twin = next((c for c in pool if looks_like(name, c)), None)
    if twin is not None:
        return explain_look_alike(name, twin)
    if name in FOREIGN:
        return FOREIGN[name]
    close = [c for c in pool if swapped(name, c)] or difflib.get_close_matches(name, pool, n=1, cutoff=0.6)
    if not close:
        same = [c for c in pool if c.casefold() == name.casefold()]
        close = same[:1]
    return f"did you mean `{close[0]}`?" if close else ""
