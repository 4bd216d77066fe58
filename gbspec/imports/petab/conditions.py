"""The conditions of a problem: what each of them changes, before a steady state, from the start, or after one.

A `Course` is what becomes a trajectory: a condition, with the one in whose steady state it begins, if there is one. A
measurement at the time `inf` belongs to a course that begins in the steady state of its condition and ends there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import libsbml

from gbspec.imports.description import Quantity, Report, Rest
from gbspec.imports.formulas import Formula, as_number, chosen, compared, named, names, number
from gbspec.imports.petab.problem import FILE, LINE, Row, Tables
from gbspec.imports.petab.second import Second
from gbspec.imports.sbml import formula_of

NUMBER, NAME, FIRST = "conditionId", "conditionName", "preequilibrationConditionId"
Parse = Callable[[str, str, Row], Formula | None]
"""The formula of a text; what has it, and where, for a refusal."""


@dataclass(frozen=True)
class Course:
    """The row of a condition, and that of the one before it."""

    name: str
    row: Row
    before: Row | None = None


@dataclass
class Conditions:
    """All courses and what distinguishes them; `constants` get a `condition` for each column of the table."""

    tables: Tables
    model: libsbml.Model
    second: Second
    report: Report
    experiment: str
    constants: dict[str, Quantity]
    parse: Parse
    courses: dict[tuple[str, str, bool], Course] = field(default_factory=dict)
    """By condition, the one before it, and whether the steady state itself is measured."""
    values: dict[str, dict[str, str]] = field(default_factory=dict)
    """The numbers of each course's columns by name."""
    assigned: dict[str, Formula] = field(default_factory=dict)
    starts: dict[str, Formula] = field(default_factory=dict)
    held: dict[str, Formula] = field(default_factory=dict)
    after: dict[str, Formula] = field(default_factory=dict)

    def read(self) -> None:
        """Everything, from the tables."""
        self._find()
        made = list(self.courses.values())
        self.rows: list[Row] = []
        for row in (row for one in made for row in (one.row, one.before) if row is not None):
            if row not in self.rows:
                self.rows.append(row)
        self.values = {one.name: {self.experiment: str(self._number(one.row))} for one in made}
        columns = dict.fromkeys(key for row in self.rows for key in row)
        for column in columns:
            if column not in (NUMBER, NAME, LINE, FILE):
                self._column(column)
        if self.experiment in set().union(*map(names, (*self.assigned.values(), *self.after.values()))):
            self._counted(self.experiment)
        if any(one.before for one in made) and self.experiment in set().union(*map(names, self.assigned.values())):
            self.held[self.experiment] = named(self._counted_before())

    @property
    def rest(self) -> Rest | None:
        """The start in a steady state, if any course has one."""
        resting = [one for one in self.courses.values() if one.before is not None]
        if not resting:
            return None
        when = None
        if len(resting) < len(self.courses):
            name = self._free("rested")
            self.constants[name] = Quantity(name, None, "1: begins in a steady state", condition=True)
            for one in self.courses.values():
                self.values[one.name][name] = str(int(one.before is not None))
            when = compared(">", named(name), number(0))
        return Rest(tuple(self.held.items()), tuple(self.after.items()), when)

    def course_of(self, row: Row) -> Course:
        """The course of a measurement."""
        return self.courses[self._key(row)]

    # ----------------------------------------------------------------------------------------------------- courses
    def _key(self, row: Row) -> tuple[str, str, bool]:
        at_rest = row.get("time", "").strip().lower() in ("inf", "+inf", "infinity")
        return row.get("simulationConditionId", ""), row.get(FIRST, ""), at_rest

    def _find(self) -> None:
        table: dict[str, Row] = {}
        for row in self.tables.conditions:
            table.setdefault(row.get(NUMBER, ""), row)
        keys = dict.fromkeys(self._key(row) for row in self.tables.measurements)
        order = {name: i for i, name in enumerate(table)}
        for key in sorted(keys, key=lambda one: (order.get(one[0], -1), one[1], one[2])):
            name, first, at_rest = key
            lacking = [one for one in (name, first) if one not in table and (one or one is name)]
            for one in lacking:
                self.report.refuse(f"condition {one}", 0, "no table has it")
            if lacking:
                continue
            others = [one for one in keys if one != key and one[0] == name]
            label = name if not others or (not first and not at_rest) else f"{name}_from_{first}" if first else name
            label = f"{label}_at_rest" if at_rest and others else label
            row, before = table[name], table.get(first) if first else None
            if before is not None:  # an experiment of PEtab 2 keeps what it does not set again
                row = {**{k: v for k, v in before.items() if k not in row and not self._moves(k)}, **row}
            if at_rest:
                row, before = self._at_rest(row, before)
            self.courses[key] = Course(label, row, before)

    def _at_rest(self, row: Row, before: Row | None) -> tuple[Row, Row]:
        """The steady state of a condition is the start of a course in which nothing is set."""
        moving = [column for column in row if self._moves(column)]
        kept = {**row, **dict.fromkeys(moving, "")}
        if before is None:
            before = row
        elif any(row[c] and not _nan(row[c]) for c in moving) or any(
            row.get(c) != before.get(c) for c in row if c not in (NUMBER, NAME, LINE, FILE, *moving)
        ):
            reason = "a measurement at the steady state that follows another steady state is not offered yet"
            self.report.refuse(f"condition {row[NUMBER]}", int(row[LINE]), reason)
        if any(one.experiment == row[NUMBER] for one in self.second.switches):
            reason = "a measurement at the steady state after a change is not offered yet"
            self.report.refuse(f"experiment {row[NUMBER]}", int(row[LINE]), reason)
        return kept, before

    def _moves(self, column: str) -> bool:
        """Whether a column sets a state, and not what is constant."""
        model = self.model
        return (
            model.getSpecies(column) is not None
            or model.getRateRuleByVariable(column) is not None
            or self.second.changes(column)
        )

    # ----------------------------------------------------------------------------------------------------- columns
    def _number(self, row: Row) -> int:
        return self.rows.index(row)

    def _column(self, column: str) -> None:
        """One quantity that conditions change."""
        made = list(self.courses.values())
        if self._moves(column):
            starting = [one.before or one.row for one in made]
            if not all(_nan(row.get(column, "")) for row in starting):
                self._start(column, starting)
            if any(one.before is not None and not _nan(one.row.get(column, "")) for one in made):
                self._after(column)
            return
        cells = [_finite(row.get(column, "")) for row in self.rows]
        if all(one is not None for one in cells):
            self._numbers(column, column, [one.row for one in made])
            first = [one.before or one.row for one in made]
            if any(one.before is not None and one.before.get(column) != one.row.get(column) for one in made):
                before = self._free(f"{column}_before")
                self._numbers(before, column, first)
                self.held[column] = named(before)
            return
        found = self._chosen(column, self.rows, self.experiment, keep=None)
        if found is not None:
            self.assigned[column] = found
            self.constants.pop(column, None)

    def _start(self, column: str, rows: list[Row]) -> None:
        if all(_finite(row.get(column, "")) is not None for row in rows):
            name = f"{column}_start"
            self._numbers(name, column, rows)
            self.starts[column] = named(name)
            return
        resting = any(one.before is not None for one in self.courses.values())
        counter = self._counted_before() if resting else self.experiment
        used = [row for row in self.rows if row in rows]
        found = self._chosen(column, used, counter, keep=None)
        if found is not None:
            if counter in names(found):
                self._counted(counter)
            self.starts[column] = found

    def _after(self, column: str) -> None:
        """What a state is set to once the steady state was found; an empty cell leaves it as it is."""
        made = [one for one in self.courses.values() if one.before is not None]
        if all(_finite(one.row.get(column, "")) is not None for one in made):
            name = self._free(f"{column}_after")
            self._numbers(name, column, [one.row for one in self.courses.values()])
            self.after[column] = named(name)
            return
        used = [row for row in self.rows if any(row == one.row for one in made)]
        found = self._chosen(column, used, self.experiment, keep=named(column))
        if found is not None:
            self.after[column] = found

    def _numbers(self, name: str, column: str, rows: list[Row]) -> None:
        """A column of the table; rows without a number have 0, which nothing uses."""
        self.constants[name] = Quantity(name, None, condition=True)
        for one, row in zip(self.courses.values(), rows, strict=True):
            cell = row.get(column, "")
            self.values[one.name][name] = cell if _finite(cell) is not None else "0"

    def _chosen(self, column: str, rows: list[Row], counter: str, keep: Formula | None) -> Formula | None:
        """A formula that chooses between the rows' values."""
        options = [self._cell(column, row, keep) for row in rows]
        if any(option is None for option in options):
            return None
        found = options[-1]
        for row, option in zip(rows[-2::-1], options[-2::-1], strict=True):
            assert found is not None
            if option is not None and option != found:
                found = chosen(compared("==", named(counter), number(self._number(row))), option, found)
        return found

    def _counted(self, name: str) -> None:
        self.constants[name] = Quantity(name, None, "number of the condition", condition=True)

    def _counted_before(self) -> str:
        """The number of the condition whose steady state comes first."""
        name = f"{self.experiment}_before"
        if name not in self.constants:
            text = "number of the condition before it, in whose steady state it begins"
            self.constants[name] = Quantity(name, None, text, condition=True)
            for one in self.courses.values():
                self.values[one.name][name] = str(self._number(one.before or one.row))
        return name

    def _free(self, name: str) -> str:
        while name in self.constants or self.model.getElementBySId(name) is not None:
            name += "_"
        return name

    # ------------------------------------------------------------------------------------------------------- cells
    def _cell(self, column: str, row: Row, keep: Formula | None) -> Formula | None:
        """The value of a cell: a number, a parameter, or, where it is empty, `keep` or what the model says."""
        cell = row.get(column, "")
        value = _finite(cell)
        if value is not None:
            return number(value)
        if not _nan(cell):
            return self.parse(cell, f"condition table, {column}", row)
        if keep is not None:
            return keep
        known = self.constants.get(column)
        if known is not None and known.learn is None and known.value is not None:
            return known.value
        return self._of_model(column, row)

    def _of_model(self, column: str, row: Row) -> Formula | None:
        """The value that the SBML model gives."""
        assignment = self.model.getInitialAssignment(column)
        if assignment is not None:
            return as_number(formula_of(assignment.getMath()))
        element = self.model.getElementBySId(column)
        for asked, got in (("isSetValue", "getValue"), ("isSetInitialConcentration", "getInitialConcentration"),
                           ("isSetSize", "getSize")):  # fmt: skip
            if hasattr(element, asked) and getattr(element, asked)():
                return number(getattr(element, got)())
        reason = "an empty cell, and the model gives no plain value"
        self.report.refuse(f"{row[FILE]}, condition table, {column}", int(row[LINE]), reason)
        return None


def _nan(cell: str) -> bool:
    """Whether a cell says nothing."""
    return not cell or cell.lower() == "nan"


def _finite(cell: str) -> float | None:
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
