"""Delays in C: how long they are, what is delayed, the state before the start, and the solution so far."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import sympy

from gbspec.backends import Flat, NotCoveredError
from gbspec.exports.c.printer import table
from gbspec.exports.c.straight import Place, Straight, function, unused
from gbspec.exports.programs import Programs
from gbspec.exports.subject import Exported
from gbspec.ir import Condition

FINE = 10.0 / 2000
"""The step of a program that simulates a trajectory, if that of the model is longer."""
SPARE = 1024
"""Steps beyond those of the longest delay, for changes of inputs, doses and outputs in between."""
MOST = 100_000
"""The most steps that are remembered."""
WIDER = 4.0
"""The longest delay is so many times its value where nothing bounds it."""
MARKS = 256
"""The most times to come at which jumps show again."""
CORNERS = 6
"""Of the bounds of so many constants all combinations are looked at."""


def delays(programs: Programs, prefix: str, place: Place, direction: Place, text: str) -> list[str]:
    """The C of all delays; `text` is that of `past.c`. Nothing for a model without delays."""
    if not programs.model.delays:
        return []
    own, point = f"const {prefix}_parameters *p", "double t, const double *x"
    moved = f"const {prefix}_parameters *dp"
    out = table("int", "DELAY_LAG", (str(k) for k in programs.lag_of))
    out += [f"enum {{ LAGS = {len(programs.lags.outputs)} }};", ""]

    def both(name: str, flat: Flat, given: str, along: str, result: str) -> Iterator[str]:
        head, names = f"void {prefix}_{name}({own}{given}, double *{result})", ["p", "t", "x", "u"]
        kept = [item for item in names if item == "p" or f"*{item}" in given or f" {item}" in given]
        lines = Straight(flat, place).body(result)
        yield from function(head, lines, unused(kept, lines))
        kept += ["dp", *(item for item in ("dt", "dx", "du") if f"*{item}" in along or f" {item}" in along)]
        lines = Straight(flat, place, direction).body("out")
        yield from function(
            f"static void {name}_along({own}{given}, {moved}{along}, double *out)", lines, unused(kept, lines)
        )

    now = f", {point}, const double *u"
    out += both("lags", programs.lags, "", "", "lags")
    out += both("delayed", programs.delayed, now, ", double dt, const double *dx, const double *du", "values")
    out += both("history", programs.history, f", {point}", ", double dt, const double *dx", "before")
    return [*out, *text.splitlines(), ""]


def room(exported: Exported, programs: Programs) -> int:
    """How many steps are remembered. Raises NotCoveredError for a delay of too many steps."""
    longest = max(map(float, _longest(exported, programs)))
    step = min(exported.step or FINE, FINE)
    if not longest / step <= MOST:
        raise NotCoveredError(f"its longest delay may be {longest:.3g}, which is more than {MOST} steps of {step:.3g}")
    return math.ceil(longest / step) + SPARE


def _longest(exported: Exported, programs: Programs) -> Iterator[float]:
    """Of each delay the largest value at the bounds of its constants and conditions."""
    model = exported.model
    items = (*model.conditions, *model.constants, *model.learnables)
    values = [*exported.conditions, *exported.constants]
    table = {item.symbol: (item, float(value)) for item, value in zip(items, values, strict=True)}
    for lag in programs.lag_values:
        symbols = sorted(lag.free_symbols, key=str)
        function = sympy.lambdify(symbols, lag, modules="math")
        ends = []
        for symbol in symbols[:CORNERS]:
            item, value = table[symbol]
            range = getattr(item, "range", None)
            known = [end for end in (range.low, range.high) if math.isfinite(end)] if range is not None else []
            wide = not math.isfinite(range.high) if range is not None else isinstance(item, Condition)
            ends.append([value, *known, *([WIDER * value] if wide else [])])
        rest = [[table[symbol][1]] for symbol in symbols[CORNERS:]]
        yield max(_finite(function(*corner)) for corner in itertools.product(*ends, *rest))


def _finite(value: float) -> float:
    return float(value) if math.isfinite(value) else 0.0
