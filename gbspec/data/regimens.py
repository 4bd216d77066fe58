"""Doses as a table gives them: amounts, how long they last, repetitions, and the regimen before them.

Everything becomes single doses here: additions at a time, and infusions as the rate that enters a state over time. A
dose in a steady state is preceded by the same dose, many times: the trajectory starts earlier by these intervals
(`RunIn`), from the initial values that the model gives. What training differentiates is then the solution itself.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data.columns import Quantity
from gbspec.data.records import Index, Records, Series
from gbspec.data.sheet import shown
from gbspec.data.trajectories import DoseEvents, RunIn, Signal
from gbspec.diagnostics import Cell, Findings
from gbspec.ir import Dose, Expr, Model

PRECEDING = 100
"""The doses before one in a steady state, where the table does not say how many."""
MOST = 10_000
"""The largest number of repetitions of a dose."""
ROUNDING = 1e-9
"""Times within this fraction of a trajectory's length are the same."""


@dataclass(frozen=True)
class Given:
    """The doses of one trajectory: those given at once, by the model's doses, and infusions [n, 3] of each: begin, end,
    rate, both times with the lag. `run_in`: what precedes `start`, the time of the doses in a steady state."""

    doses: tuple[DoseEvents, ...]
    infusions: tuple[Array, ...]
    run_in: RunIn | None = None
    start: float = np.nan


def regimens(table: Records, model: Model, conditions: Array, findings: Findings) -> list[Given]:
    """The doses of each trajectory of a table, whose conditions are [trajectories, conditions]; reports errors."""
    count = len(table.labels)
    doses: list[list[DoseEvents]] = [[] for _ in range(count)]
    infusions: list[list[Array]] = [[] for _ in range(count)]
    steady: dict[int, list[tuple[float, float, int]]] = {}
    for index, dose in enumerate(model.doses):
        rows = _Rows.of(table, model, index, findings)
        if findings.failed:
            continue
        for g in range(count):
            time, amount, lasts, run_in = rows.expanded(g, conditions[g], model, dose, findings)
            steady.setdefault(g, []).extend(run_in)
            last = lasts > 0
            doses[g].append(_in_time(time[~last], amount[~last]))
            # A duration below the smallest number times the amount is at once, and so never divides here by zero.
            late = _number(dose.lag, model, conditions[g]) if last.any() else 0.0
            begin = time[last] + late
            infusions[g].append(np.column_stack([begin, begin + lasts[last], amount[last] / lasts[last]]))
    findings.raise_if_failed()
    return [Given(tuple(doses[g]), tuple(infusions[g]), *_run_in(steady.get(g, []))) for g in range(count)]


def _run_in(steady: list[tuple[float, float, int]]) -> tuple[RunIn | None, float]:
    """The longest of the regimens before a time, and that time, from times, intervals and numbers of doses."""
    if not steady:
        return None, np.nan
    start, interval, number = max(steady, key=lambda one: one[1] * one[2])
    return RunIn(interval, number), start


def _in_time(time: Array, amount: Array) -> DoseEvents:
    order = np.argsort(time, kind="stable")
    return DoseEvents(time[order], amount[order])


@dataclass(frozen=True)
class _Rows:
    """The doses into one state in the order of the table: keys, times, amounts, and what their columns say [n] (NaN:
    an empty cell)."""

    table: Records
    column: str
    cells: Series
    words: dict[str, Array]

    @classmethod
    def of(cls, table: Records, model: Model, index: int, findings: Findings) -> _Rows:
        found = {q: cells for q, cells in table.series.items() if q.index == index and q.role in ("dose", "regimen")}
        nothing = Series(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0))
        cells = next((cells for q, cells in found.items() if q.role == "dose"), nothing)
        words = {}
        for quantity, said in found.items():
            if quantity.role == "regimen":
                of_key = np.full(len(table.time), np.nan)
                of_key[said.key] = said.value
                _alone(table, quantity, cells, said, findings)
                words[quantity.word] = of_key[cells.key]
        rows = cls(table, model.doses[index].state, cells, words)
        rows.check(model, model.doses[index], findings)
        return rows

    def word(self, name: str) -> Array:
        """What a column says of each dose; 0 where it says nothing."""
        return np.nan_to_num(self.words.get(name, np.zeros(len(self.cells.key))), nan=0.0)

    def check(self, model: Model, dose: Dose, findings: Findings) -> None:
        """Reports what makes no sense."""
        interval, more, steady = self.word("ii"), self.word("addl"), self.word("ss")
        rate, lasts = self.word("rate"), self.word("dur")
        for name, values in (("ii", interval), ("addl", more), ("ss", steady), ("rate", rate), ("dur", lasts)):
            self._tell("GB746", name, values < 0, "is negative", "leave the cell empty where it does not apply",
                       findings)  # fmt: skip
        for name, values in (("addl", more), ("ss", steady)):
            wrong = (values != np.round(values)) | (values > MOST)
            self._tell("GB746", name, wrong, "is not a whole number of doses",
                       f"give a whole number, at most {MOST:,}", findings)  # fmt: skip
            self._tell("GB746", name, (values > 0) & ~(interval > 0), "needs an interval between doses",
                       f"fill `ii_{self.column}` in the same row", findings)  # fmt: skip
        self._tell("GB747", "rate", (rate > 0) & (lasts > 0), f"stands beside `dur_{self.column}`",
                   "the duration is the amount divided by the rate: give one of them", findings)  # fmt: skip
        self._tell("GB747", "rate", (rate > 0) & (self.cells.value < 0), "belongs to a negative amount",
                   "an infusion adds: give a positive amount, or leave out the rate", findings)  # fmt: skip
        if dose.duration is None:
            for name, values in (("rate", rate), ("dur", lasts)):
                help = f"write `dose {self.column} over 0` in the model, where 0 stands for doses without a duration"
                self._tell("GB748", name, values > 0, f"asks for an infusion, and `dose {self.column}` adds at once",
                           help, findings)  # fmt: skip
        if (steady > 0).any():
            self._first(steady > 0, findings)
            self._starts(model, findings)

    def _tell(self, code: str, name: str, wrong: Mask, what: str, help: str, findings: Findings) -> None:
        for i, notes in shown(np.flatnonzero(wrong), "cells"):
            row, column = int(self.cells.row[i]), f"{name}_{self.column}"
            message = f"`{column}` is {self.word(name)[i]:g} in row {row}: it {what}"
            findings.error(code, message, Cell(self.table.path, row, column), help=help, notes=notes)

    def _first(self, steady: Mask, findings: Findings) -> None:
        """Reports doses in a steady state that are not the beginning of their trajectory."""
        key, table = self.cells.key, self.table
        groups, index = np.unique(table.group, return_index=True)
        first = np.full(len(table.labels), np.nan)
        first[groups] = table.time[index]
        late = steady & (table.time[key] > first[table.group[key]])
        self._tell("GB749", "ss", late, "is not the first row of its trajectory",
                   "begin a new trajectory there: what happened before has no effect in a steady state",
                   findings)  # fmt: skip

    def _starts(self, model: Model, findings: Findings) -> None:
        learned = [state.name for state in model.states if not state.initial.known]
        if learned:
            column = f"ss_{self.column}"
            findings.error(
                "GB757",
                f"`{column}` asks for a steady state, and the model does not give the initial value of `{learned[0]}`",
                Cell(self.table.path, None, column),
                help=f"write `initial {learned[0]} = 0`: the doses before then lead from it to the steady state",
            )

    def expanded(
        self, group: int, condition: Array, model: Model, dose: Dose, findings: Findings
    ) -> tuple[Array, Array, Array, list[tuple[float, float, int]]]:
        """Times, amounts and durations of a trajectory's single doses, and the regimens before them."""
        mine = np.arange(*np.searchsorted(self.table.group[self.cells.key], (group, group + 1)))
        time, amount = self.table.time[self.cells.key[mine]], self.cells.value[mine]
        if not self.words and dose.duration is None:
            return time, amount, np.zeros(len(mine)), []
        interval, more, steady = (self.word(name)[mine] for name in ("ii", "addl", "ss"))
        lasts = self._durations(mine, amount, condition, model, dose, findings)
        before = np.where(steady == 1, PRECEDING, steady).astype(np.int64)
        number = before + more.astype(np.int64) + 1
        which = np.repeat(np.arange(len(mine)), number)
        place = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number) - before[which]
        again = np.flatnonzero(before)
        run_in = [(float(time[i]), float(interval[i]), int(before[i])) for i in again]
        return time[which] + place * interval[which], amount[which], lasts[which], run_in

    def _durations(
        self, mine: Index, amount: Array, condition: Array, model: Model, dose: Dose, findings: Findings
    ) -> Array:
        """How long each dose lasts: as the table says, else as the model says; 0: at once."""
        if dose.duration is None or not len(mine):
            return np.zeros(len(mine))
        usual = _number(dose.duration, model, condition)
        rate, lasts = self.word("rate")[mine], self.words.get("dur", np.full(len(self.cells.key), np.nan))[mine]
        given = np.isfinite(self.words.get("rate", np.full(len(self.cells.key), np.nan))[mine]) | np.isfinite(lasts)
        if not given.all() and not (np.isfinite(usual) and usual >= 0):
            findings.error(
                "GB758",
                f"the infusions into `{self.column}` last {usual:g} in trajectory `{self._label(mine)}`",
                Cell(self.table.path, int(self.cells.row[mine[0]]), None),
                help=f"the expression after `over` is zero or more under all conditions; or fill `dur_{self.column}`",
            )
            return np.zeros(len(mine))
        said = np.where(rate > 0, amount / np.where(rate > 0, rate, 1.0), np.nan_to_num(lasts, nan=0.0))
        return np.where(given, said, usual)

    def _label(self, mine: Index) -> str:
        return self.table.labels[int(self.table.group[self.cells.key[mine[0]]])]


def _alone(table: Records, quantity: Quantity, doses: Series, said: Series, findings: Findings) -> None:
    """Reports what is said of a dose where there is none; a zero says nothing."""
    alone = np.flatnonzero(~np.isin(said.key, doses.key) & (said.value != 0))
    for i, notes in shown(alone, "cells"):
        row = int(said.row[i])
        findings.error(
            "GB745",
            f"`{quantity.column}` is {said.value[i]:g} in row {row}, where no dose into `{quantity.name}` is given",
            Cell(table.path, row, quantity.column),
            help=f"fill `dose_{quantity.name}` in the same row, or leave this cell empty",
            notes=notes,
        )


def _number(expression: Expr, model: Model, condition: Array) -> float:
    """An expression of constants and conditions as a number; NaN where it has no finite value."""
    if expression.is_number:
        return float(expression)
    known = {constant.symbol: constant.value for constant in model.constants}
    known |= {each.symbol: float(value) for each, value in zip(model.conditions, condition, strict=True)}
    value = expression.subs(known)
    return float(value) if value.is_real and value.is_finite else np.nan


def with_infusions(
    model: Model, given: Given, signals: Sequence[Signal], start: float, rows: Array
) -> tuple[Signal, ...]:
    """A trajectory's inputs, with the rates of its infusions; `rows` are its times."""
    place = {dose.infusion: i for i, dose in enumerate(model.doses) if dose.infusion}
    moments = np.concatenate([rows, *(events.times for events in given.doses)])
    return tuple(
        rate(signal, given.infusions[place[one.name]], start, moments) if one.name in place else signal
        for signal, one in zip(signals, model.inputs, strict=True)
    )


def lasting(
    model: Model,
    condition: Array,
    doses: Sequence[DoseEvents],
    signals: Sequence[Signal],
    drawn: Collection[str],
    span: tuple[float, float],
) -> tuple[tuple[DoseEvents, ...], tuple[Signal, ...]]:
    """Doses and inputs of a simulated trajectory between two times, in which those of the states `drawn` last as the
    model says, in place of any infusion into these states."""
    events, infusions, found = list(doses), [np.zeros((0, 3)) for _ in doses], list(signals)
    for i, dose in enumerate(model.doses):
        if dose.duration is None or dose.state not in drawn:
            continue
        lasts = _number(dose.duration, model, condition)
        j = next(j for j, one in enumerate(model.inputs) if one.name == dose.infusion)
        found[j] = Signal(np.array([span[0]]), np.zeros(1))
        if lasts > 0:
            begin = doses[i].times + _number(dose.lag, model, condition)
            infusions[i] = np.column_stack([begin, begin + lasts, doses[i].amounts / lasts])
            events[i] = DoseEvents(np.zeros(0), np.zeros(0))
    given = Given(tuple(events), tuple(infusions))
    return given.doses, with_infusions(model, given, found, span[0], np.array(span))


def rate(signal: Signal, infusions: Array, start: float, anchors: Array) -> Signal:
    """A rate of infusion [held] with infusions [n, 3] (begin, end, rate) added to it, known from `start` on.

    Ends within rounding of each other, or of `anchors` (times of rows), are the same time.
    """
    if not len(infusions):
        return signal
    edges = infusions[:, :2].ravel()
    whole = np.concatenate([signal.times, edges, anchors])
    tolerance = ROUNDING * max(float(np.ptp(whole)), float(np.abs(whole).max()))
    moved = _snapped(edges, np.sort(np.concatenate([signal.times, anchors])), tolerance).reshape(-1, 2)
    times = np.unique(np.concatenate([signal.times, moved.ravel(), [start]]))
    steps, active = np.zeros(len(times)), np.zeros(len(times), dtype=np.int64)
    for column, sign in ((0, 1), (1, -1)):
        at = np.searchsorted(times, moved[:, column])
        np.add.at(steps, at, sign * infusions[:, 2])
        np.add.at(active, at, sign)
    # Where none lasts, the rate is exactly zero: the sum of additions and subtractions is so only up to rounding.
    values = np.where(np.cumsum(active) > 0, np.cumsum(steps), 0.0)
    index = np.searchsorted(signal.times, times, side="right") - 1
    base = signal.values[np.clip(index, 0, len(signal.values) - 1)] if len(signal.values) else 0.0
    return Signal(times, values + base)


def _snapped(times: Array, anchors: Array, tolerance: float) -> Array:
    """Times, those within a tolerance of an anchor or of the first of a group of close times moved there."""
    order = np.argsort(times, kind="stable")
    found = times[order].copy()
    for i in range(len(found)):
        near = anchors[np.argmin(np.abs(anchors - found[i]))] if len(anchors) else np.inf
        if abs(near - found[i]) <= tolerance:
            found[i] = near
        elif i and found[i] - found[i - 1] <= tolerance:
            found[i] = found[i - 1]
    out = np.empty_like(found)
    out[order] = found
    return out
