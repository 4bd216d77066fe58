"""Tables in the form of NONMEM: one row for each event of a subject, in columns ID, TIME, DV, AMT, EVID, CMT and more.

Rows become the same records as those of other tables, so that all that follows is the same. The meaning of the columns
is in `docs/data.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data.cells import labels, numbers
from gbspec.data.columns import Quantity, quantities
from gbspec.data.formats import Format
from gbspec.data.limits import Sides, measured
from gbspec.data.names import similar
from gbspec.data.records import Index, Records, Series
from gbspec.data.sheet import Sheet, shown
from gbspec.diagnostics import Cell, Findings
from gbspec.ir import Model

NEEDED = ("ID", "TIME", "DV")
"""The columns by which the form is recognised."""
EVENTS = ("AMT", "RATE", "II", "ADDL", "SS", "EVID", "MDV", "CMT", "DVID", "CENS")
"""The other columns that mean something by themselves."""
BY_MODEL, MODELLED = -2.0, -1.0
"""Rates that say how a dose lasts: as long as the model says; at a rate that is a parameter."""


def is_nonmem(sheet: Sheet, model: Model) -> bool:
    """Whether a table has the columns of the form, and no name of the model stands for one of them."""
    taken = {c.column for c in quantities(model)} | {model.time.name}
    found = _columns(sheet)
    return all(name in found and found[name] not in taken for name in NEEDED)


def _columns(sheet: Sheet) -> dict[str, str]:
    """The columns with a meaning of their own, by their names in capitals."""
    return {name.upper(): name for name in sheet.columns if name.upper() in (*NEEDED, *EVENTS)}


@dataclass
class _Table:
    """The rows of a table that have a time: their columns as numbers [n], subjects, and the rows of the file."""

    sheet: Sheet
    names: dict[str, str]
    findings: Findings
    subjects: list[str]
    subject: Index
    row: Index
    kept: Index
    side: Sides
    values: dict[str, Array] = field(default_factory=dict)

    def column(self, name: str, default: float = np.nan) -> Array:
        """A column of events; cells that are empty have the default."""
        if name not in self.values:
            found = np.full(len(self.kept), np.nan)
            if name in self.names:
                found = numbers(self.sheet, self.names[name], self.findings)[self.kept]
            self.values[name] = found
        return np.where(np.isnan(self.values[name]), default, self.values[name])

    def told(self, code: str, name: str, wrong: Mask, what: str, help: str, *, warning: bool = False) -> None:
        """Reports rows that are wrong in a column; `{}` in the message stands for its value."""
        report: Callable[..., None] = self.findings.warning if warning else self.findings.error
        for i, notes in shown(np.flatnonzero(wrong), "rows"):
            row, value = int(self.row[i]), self.column(name)[i]
            place = Cell(self.sheet.path, row, self.names.get(name))
            report(code, f"row {row}: {what.format(f'{value:g}')}", place, help=help, notes=notes)


def nonmem_records(
    sheet: Sheet, model: Model, wanted: tuple[Quantity, ...], form: Format, findings: Findings
) -> Records | None:
    """The records of a table in the form of NONMEM; None (and at least one error) if it cannot be read."""
    names = _columns(sheet)
    for name in NEEDED:
        if name not in names:
            meant = similar(name, sheet.names)
            findings.error(
                "GB710",
                f"the table has no column `{name}`, which a table in the form of NONMEM has",
                Cell(sheet.path, sheet.header, name),
                help=f"rename the column `{meant}`" if meant else "read it as an ordinary table: `--format table`",
            )
    if any(name not in names for name in NEEDED):
        return None
    subjects, subject = labels(sheet, names["ID"], findings)
    time = numbers(sheet, names["TIME"], findings)
    kept = np.flatnonzero(~np.isnan(time)).astype(np.int64)
    for i, notes in shown(np.flatnonzero(np.isnan(time)), "rows"):
        row = int(sheet.rows[i])
        if not findings.failed:
            findings.error("GB714", f"row {row} has no time", Cell(sheet.path, row, names["TIME"]), notes=notes)
    value, side = measured(sheet, names["DV"], findings)
    columns = {"TIME": time[kept], "DV": value[kept]}
    table = _Table(sheet, names, findings, subjects, subject[kept], sheet.rows[kept], kept, side[kept], columns)
    return _records(table, model, wanted, form)


def _records(table: _Table, model: Model, wanted: tuple[Quantity, ...], form: Format) -> Records:
    amount, rate = table.column("AMT", 0.0), table.column("RATE", 0.0)
    event = table.column("EVID")
    event = np.where(np.isnan(event), np.where((amount != 0) | (rate != 0), 1.0, 0.0), event)
    dosed = np.isin(event, (1.0, 4.0))
    _offered(table, event, dosed)
    pieces = _Pieces.of(table, event, dosed, model)
    order = np.lexsort((table.row, table.column("TIME"), pieces.group))
    new = np.ones(len(order), dtype=bool)
    time = table.column("TIME")
    new[1:] = (pieces.group[order][1:] != pieces.group[order][:-1]) | (time[order][1:] != time[order][:-1])
    key_of = np.empty(len(order), dtype=np.int64)
    key_of[order] = np.cumsum(new) - 1
    first = order[new]
    series: dict[Quantity, Series] = {}
    doses = _doses(table, dosed, key_of, order, model, wanted, form)
    results = _measurements(table, event, key_of, order, model, wanted, form)
    given = {name for name in table.sheet.columns if name not in table.names.values()}
    for quantity in wanted:
        if quantity.role in ("condition", "input") and quantity.column in given:
            values = numbers(table.sheet, quantity.column, table.findings)[table.kept]
            series[quantity] = _series(values, ~np.isnan(values), key_of, order, table.row)
        elif quantity.role == "condition" and quantity.required:
            table.findings.error(
                "GB710",
                f"the table has no column `{quantity.column}` for the condition `{quantity.name}`",
                Cell(table.sheet.path, table.sheet.header, quantity.column),
                help=f"its columns are {', '.join(f'`{name}`' for name in table.sheet.names)}",
            )
    series |= doses | results
    _after_doses(table, event, dosed, key_of, model)
    return Records(table.sheet.path, pieces.labels, pieces.group[first], time[first], table.row[first], series,
                   table.names["TIME"], pieces.starts)  # fmt: skip


def _offered(table: _Table, event: Array, dosed: Mask) -> None:
    """Reports events that are not offered (GB760)."""
    table.told("GB760", "EVID", ~np.isin(event, (0.0, 1.0, 2.0, 3.0, 4.0)), "there is no event {}",
               "EVID is 0 (measurement), 1 (dose), 2 (other), 3 (reset) or 4 (reset and dose)")  # fmt: skip
    table.told("GB760", "CMT", table.column("CMT", 0.0) < 0, "compartment {} is turned off, which is not offered",
               "let the model depend on a condition or an input instead")  # fmt: skip
    rate, steady = table.column("RATE", 0.0), table.column("SS", 0.0)
    table.told("GB760", "RATE", dosed & (rate == MODELLED), "a rate that is learned (RATE {}) is not offered",
               "give the rate, or -2 for the duration that the model says (`dose S over D`)")  # fmt: skip
    other = (rate < 0) & ~np.isin(rate, (MODELLED, BY_MODEL))
    table.told("GB760", "RATE", dosed & other, "the rate of a dose is {}", "give a rate above zero, 0 or -2")
    table.told("GB760", "SS", dosed & ~np.isin(steady, (0.0, 1.0)), "SS {} is not offered", "SS is 0 or 1")
    table.told("GB760", "AMT", dosed & (table.column("AMT", 0.0) == 0),
               "a dose without an amount (AMT {}) is not offered: an infusion of unknown end is no dose",
               "give the amount; or an `input` of the model for what flows all the time")  # fmt: skip


@dataclass(frozen=True)
class _Pieces:
    """Trajectories: subjects, cut where they are reset; `starts` [trajectories] is NaN where nothing says it."""

    labels: list[str]
    group: Index
    starts: Array

    @classmethod
    def of(cls, table: _Table, event: Array, dosed: Mask, model: Model) -> _Pieces:
        """A subject's rows stand in the order of time; a reset, and a steady state, begin a new trajectory."""
        order = np.argsort(table.subject, kind="stable")
        subject, time = table.subject[order], table.column("TIME")[order]
        begins = np.ones(len(order), dtype=bool)
        begins[1:] = subject[1:] != subject[:-1]
        steady = dosed[order] & (table.column("SS", 0.0)[order] == 1)
        cut = (np.isin(event[order], (3.0, 4.0)) | steady) & ~begins
        same = np.zeros(len(order), dtype=bool)
        same[1:] = ~begins[1:] & (time[1:] == time[:-1])
        cut &= ~(steady & same & ~np.isin(event[order], (3.0, 4.0)))  # a second dose of the same steady state
        back = np.zeros(len(order), dtype=bool)
        back[1:] = ~begins[1:] & ~cut[1:] & (time[1:] < time[:-1])
        wrong = np.zeros(len(order), dtype=bool)
        wrong[order[back]] = True
        table.told("GB715", "TIME", wrong, "time goes back to {} within a subject",
                   "sort its rows by time, or reset it there (EVID 3 or 4)")  # fmt: skip
        if model.distributed:
            wrong = np.zeros(len(order), dtype=bool)
            wrong[order[cut]] = True
            table.told("GB763", "EVID", wrong, "a subject that is reset would be two of the population",
                       "leave out the rows before the reset, or those from it on")  # fmt: skip
        number = np.cumsum(begins | cut) - 1
        group = np.empty(len(order), dtype=np.int64)
        group[order] = number
        head = np.flatnonzero(begins | cut)
        place = np.arange(len(head)) - np.maximum.accumulate(np.where(begins[head], np.arange(len(head)), 0))
        names = [table.subjects[subject[i]] + (f" ({k + 1})" if k else "") for i, k in zip(head, place, strict=True)]
        return cls(names, group, np.where(cut[head], time[head], np.nan))


def _series(values: Array, there: Mask, key: Index, order: Index, row: Index) -> Series:
    """The filled cells of a column in the order of keys."""
    here = order[there[order]]
    return Series(key[here], values[here], row[here], np.full(len(here), np.nan))


def _doses(
    table: _Table, dosed: Mask, key: Index, order: Index, model: Model, wanted: tuple[Quantity, ...], form: Format
) -> dict[Quantity, Series]:
    """The amounts of each dosed state and what is said of them."""
    place = _numbered(table, dosed, {i: state for state, i in _dosed_states(model)}, form.doses(model), "dose")
    rate = table.column("RATE", 0.0)
    said = {
        "rate": np.where(rate == BY_MODEL, np.nan, rate),
        "ii": table.column("II"),
        "addl": table.column("ADDL"),
        "ss": table.column("SS"),
    }
    found: dict[Quantity, Series] = {}
    for quantity in wanted:
        mine = dosed & (place == quantity.index)
        if quantity.role == "dose":
            found[quantity] = _series(table.column("AMT", 0.0), mine, key, order, table.row)
        elif quantity.role == "regimen" and quantity.word in said:
            values = said[quantity.word]
            lasting = model.doses[quantity.index].duration is not None
            there = mine & ~np.isnan(values) & ((values != 0) | (lasting and quantity.word == "rate"))
            if there.any():
                found[quantity] = _series(values, there, key, order, table.row)
    _one_regimen(table, dosed, key, place, said)
    return found


def _one_regimen(table: _Table, dosed: Mask, key: Index, place: Index, said: Mapping[str, Array]) -> None:
    """Reports two doses into a state at one time that are given in different ways (GB760)."""
    first: dict[tuple[int, int], int] = {}
    wrong = np.zeros(len(key), dtype=bool)
    for i in np.flatnonzero(dosed):
        j = first.setdefault((int(key[i]), int(place[i])), int(i))
        wrong[i] = any(not np.array_equal(v[i], v[j], equal_nan=True) for v in said.values())
    table.told("GB760", "AMT", wrong, "a second dose into the same state at this time ({}) is given in another way",
               "give it a little later: doses of one time share rate, interval and steady state")  # fmt: skip


def _dosed_states(model: Model) -> Iterator[tuple[int, int]]:
    """The index of each dose and the number of its state among all states, from 1."""
    for i, dose in enumerate(model.doses):
        yield i, model.state_index[dose.state] + 1


def _measurements(
    table: _Table, event: Array, key: Index, order: Index, model: Model, wanted: tuple[Quantity, ...], form: Format
) -> dict[Quantity, Series]:
    """The measured values of each channel; CENS is 1 where they lie below DV, and -1 where above."""
    value = table.column("DV")
    seen = (event == 0) & (table.column("MDV", 0.0) == 0) & ~np.isnan(value)
    states = {channel.state + 1: i for i, channel in enumerate(model.channels) if channel.state is not None}
    if "DVID" in table.names:
        place = _numbered(table, seen, {i + 1: i for i in range(len(model.channels))}, {}, "channel", "DVID")
    elif len(model.channels) == 1 and not form.channels(model):
        place = np.zeros(len(value), dtype=np.int64)
    else:
        place = _numbered(table, seen, states, form.channels(model), "channel")
    limit = table.column("CENS", 0.0)
    table.told("GB760", "CENS", ~np.isin(limit, (-1.0, 0.0, 1.0)), "CENS {} is not offered",
               "CENS is 1 (below DV), -1 (above it) or 0")  # fmt: skip
    side = np.where(limit != 0, -limit, table.side).astype(np.int8)
    found = {}
    for quantity in wanted:
        here = seen & (place == quantity.index)
        if quantity.role == "channel" and here.any():
            cells = _series(value, here, key, order, table.row)
            sides = side[order[here[order]]]
            found[quantity] = replace(cells, side=sides if sides.any() else None)
    return found


def _numbered(
    table: _Table, where: Mask, by_order: Mapping[int, int], said: Mapping[int, int], what: str, column: str = "CMT"
) -> Index:
    """The index of the dose or channel that each row means by a number; -1: none, which is reported (GB761)."""
    numbers_of, found = table.column(column, 0.0), np.full(len(where), -1, dtype=np.int64)
    known = {**by_order, **said}
    only = next(iter(known.values())) if len(set(known.values())) == 1 and not said else None
    if only is not None and column == "CMT":
        known = {0: only, **known}
    for number, index in known.items():
        found[numbers_of == number] = index
    if only is not None and column not in table.names:
        found[:] = only
    table.told("GB761", column, where & (found < 0), f"the model has no {what} for {column} {{}}",
               _meant(known, what, column))  # fmt: skip
    return found


def _meant(known: Mapping[int, int], what: str, column: str) -> str:
    """Which numbers there are, and how to say what others mean."""
    listed = ", ".join(str(number) for number in sorted(known) if number) or "none"
    by = "in the order of `observe`" if column == "DVID" else "in the order of the states"
    how = "" if column == "DVID" else "; say what a number means by `--format nonmem:1=gut,2=conc`"
    return f"those with a {what} are {listed} ({by}){how}"


def _after_doses(table: _Table, event: Array, dosed: Mask, key: Index, model: Model) -> None:
    """Warns of measurements that stand behind a dose at the same time and would contain it (GB762)."""
    direct = {dose.state for dose in model.doses} & {
        symbol.name for value in model.inlined([c.value for c in model.channels]) for symbol in value.free_symbols
    }
    if not direct:
        return
    at_once = dosed & (table.column("RATE", 0.0) == 0)
    seen = (event == 0) & (table.column("MDV", 0.0) == 0) & ~np.isnan(table.column("DV"))
    first = np.full(int(key.max(initial=-1)) + 1, np.iinfo(np.int64).max)
    np.minimum.at(first, key[at_once], table.row[at_once])
    table.told("GB762", "DV", seen & (table.row > first[key]),
               "a measurement ({}) stands behind a dose at the same time, and is taken as made before it",
               "give it a time a little later if it was made after the dose", warning=True)  # fmt: skip
