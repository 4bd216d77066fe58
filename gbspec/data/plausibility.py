"""Numbers of a table that cannot be what the model means: codes for missing values, and columns in another unit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data.columns import Quantity
from gbspec.data.records import Index, Records, Series
from gbspec.diagnostics import Cell, Findings
from gbspec.ir import Model, Range

NOISE = 0.01
"""The share of a declared range by which noise may carry a measured value out of it without a warning."""
BEYOND = 0.1
"""Arguments of unknown functions further outside of their range than this part of it are far outside."""
MOST = 3
"""A column is taken for one of another unit where most of its values, and at least so many, lie outside."""

CODES = (-999.0, -9999.0, -99999.0, -999.9, -9999.9, -99.0, -99.9, 999.0, 9999.0, 99999.0, 99.0, -9.0, -1.0)
"""What tables have in place of an empty cell."""
SHORT = 10.0
"""Codes below this size are usual numbers, above all of inputs."""
UNUSUAL = 999.0
"""From this size on a negative code is one also where it is in most cells, as of what is measured rarely."""
DISTINCT = 5
"""A column with fewer different values beside a code may consist of levels, of which the code is one."""
FAR = 3.0
"""A code is that many widths of all other values away from them; one that is negative among positive values, and not
short, one width."""


def check_plausibility(table: Records, model: Model, quantity: Quantity, cells: Series, findings: Findings) -> None:
    """Warns of values that are codes for missing ones (GB791), and of those outside of the declared range (GB725)."""
    code = missing_code(cells.value, quantity) if cells.side is None or not (cells.side != 0).all() else None
    if code is not None:
        _coded(table, quantity, cells, code, findings)
        cells = cells.where(cells.value != code)
    _in_range(table, quantity, cells, findings)
    if quantity.role in ("channel", "input", "condition"):
        name = _measured_state(model, quantity) if quantity.role == "channel" else quantity.name
        _as_argument(table, model, quantity.column, name, (cells.row, cells.value), findings, quantity.range)


def check_times(table: Records, model: Model, findings: Findings) -> None:
    """Warns where most times lie far outside of the range of an unknown function's argument."""
    _as_argument(table, model, table.time_column, model.time.name, (table.row, table.time), findings, None)


def missing_code(values: Array, quantity: Quantity) -> float | None:
    """The code for missing values that a column contains: far outside of all its other values, which are many different
    ones."""
    if quantity.role not in ("channel", "input", "condition") or quantity.categories or quantity.labels:
        return None
    others = values[~np.isin(values, CODES)]
    if len(np.unique(others)) < DISTINCT:
        return None
    low, high = float(others.min()), float(others.max())
    width = high - low
    for code in CODES:
        short, times = abs(code) < SHORT, int(np.sum(values == code))
        if (
            not times
            or (short and (quantity.role == "input" or low <= 0))
            or (code > -UNUSUAL and 2 * times > len(values))
        ):
            continue
        # A positive one may be what a decay begins with, or the largest of few levels.
        if code > 0 and (quantity.role != "channel" or times == 1 or values[0] == code):
            continue
        below_positive = code < 0 <= low + BEYOND * high and not short
        if max(low - code, code - high) > (1.0 if below_positive else FAR) * width:
            return code
    return None


def _coded(table: Records, quantity: Quantity, cells: Series, code: float, findings: Findings) -> None:
    found, others = cells.row[cells.value == code], cells.value[~np.isin(cells.value, CODES)]
    row, count = int(found.min()), len(found)
    where = f"in row {row}" if count == 1 else f"in {count:,} cells, the first in row {row}"
    empty = "leave these cells empty" if count > 1 else "leave this cell empty"
    advice = f"{empty} where nothing was measured"
    if quantity.role != "channel":
        advice = "put what the value was, as far as it is known, in its place"
    if quantity.role == "input":
        advice += ": where a cell is empty the value before holds, or is interpolated"
    findings.warning(
        "GB791",
        f"`{quantity.column}` is {code:g} {where}, and from {others.min():g} to {others.max():g} elsewhere: this may "
        "be a code for a missing value, and is read as a number",
        Cell(table.path, row, quantity.column),
        help=advice,
        subject=quantity.name,
    )


def _in_range(table: Records, quantity: Quantity, cells: Series, findings: Findings) -> None:
    """Warns once per column with values outside its declared range, measured ones by more than noise may be."""
    bounds = quantity.range
    if bounds is None:
        return
    noise = NOISE * (bounds.high - bounds.low) if quantity.role == "channel" and bounds.bounded else 0.0
    known = np.ones(len(cells.value), dtype=np.bool_) if cells.side is None else cells.side == 0
    outside = np.flatnonzero(known & ((cells.value < bounds.low - noise) | (cells.value > bounds.high + noise)))
    if not len(outside):
        return
    first = outside[np.argmin(cells.row[outside])]
    row, value, count = int(cells.row[first]), float(cells.value[first]), len(outside)
    others = f" (so are {count - 1:,} more)" if count > 2 else " (so is one more)" if count == 2 else ""
    advice = "widen the range in the model if such values are plausible"
    if _mostly(outside, known):
        values = cells.value[outside]
        others = (
            f" (so are {count - 1:,} more of {known.sum():,} values: from {values.min():.6g} to {values.max():.6g})"
        )
        advice = f"most values lie outside: {_asked(values, bounds)}; {advice}"
    findings.warning(
        "GB725",
        f"`{quantity.column}` is {value:g} in row {row}, outside its range {interval(bounds)}{others}",
        Cell(table.path, row, quantity.column),
        help=advice,
        subject=quantity.name,
    )


_ANOTHER_UNIT = (
    "is the column in another unit than the model (nothing is converted), or exchanged with another column? Convert it "
    "in the table or in the model"
)


def _asked(values: Array, bounds: Range) -> str:
    """What may be the matter with a column of which these values lie outside of its range."""
    turned = np.mean((-values >= bounds.low) & (-values <= bounds.high)) > 0.5
    return f"has the column the opposite sign, or {_ANOTHER_UNIT}" if turned else _ANOTHER_UNIT


def _mostly(outside: Index, known: Mask) -> bool:
    return len(outside) >= MOST and 2 * len(outside) > known.sum()


def interval(bounds: Range) -> str:
    """A range, as it is told."""
    return f"[{bounds.low:g}, {bounds.high:g}]"


@dataclass(frozen=True)
class _Use:
    """Where an unknown function has a quantity itself as an argument, with the range that is declared of it."""

    unknown: str
    argument: str
    bounds: Range


def _as_argument(
    table: Records,
    model: Model,
    column: str,
    name: str,
    cells: tuple[Index, Array],
    findings: Findings,
    told: Range | None,
) -> None:
    """Warns where most values of a quantity lie far outside of the range of an argument that it is; where that is the
    range `told` of the quantity itself, this is said of the column."""
    rows, values = cells
    known = np.isfinite(values)
    for use in _uses(model, name) if name else ():
        margin = BEYOND * (use.bounds.high - use.bounds.low)
        far = np.flatnonzero(known & ((values < use.bounds.low - margin) | (values > use.bounds.high + margin)))
        if use.bounds == told or not _mostly(far, known):
            continue
        first = far[np.argmin(rows[far])]
        row = int(rows[first])
        findings.warning(
            "GB725",
            f"`{column}` is {values[first]:g} in row {row}, far outside the range {interval(use.bounds)} of the "
            f"argument `{use.argument}` of `{use.unknown}` (so are {len(far) - 1:,} more of {known.sum():,} values: "
            f"from {values[far].min():.6g} to {values[far].max():.6g})",
            Cell(table.path, row, column),
            help=f"most values lie outside: {_asked(values[far], use.bounds)}; change the range of the argument if "
            "such values are meant",
            subject=name,
        )
        return


def _uses(model: Model, name: str) -> Iterator[_Use]:
    from sympy.core.function import AppliedUndef

    from gbspec.ir import symbol

    if not model.unknowns:
        return
    by_name = {unknown.name: unknown for unknown in model.unknowns}
    lets, channels = (one.value for one in model.intermediates), (one.value for one in model.channels)
    expressions = (*model.balances, *lets, *channels)
    found = {call for expression in expressions for call in expression.atoms(AppliedUndef)}
    for applied in sorted(found, key=str):
        unknown = by_name.get(applied.func.__name__)
        if unknown is None:
            continue
        periodic = {contract.argument for contract in unknown.contracts if contract.kind == "period"}
        for formal, argument in zip(model.networks[unknown.network].arguments, applied.args, strict=False):
            bounded = formal.range is not None and formal.range.bounded
            if argument == symbol(name) and bounded and formal.name not in periodic and formal.range is not None:
                yield _Use(unknown.name, formal.name, formal.range)


def _measured_state(model: Model, quantity: Quantity) -> str:
    """The state that a channel measures, whose argument its values are; empty if it is an expression."""
    state = model.channels[quantity.index].state
    return "" if state is None else model.states[state].name
