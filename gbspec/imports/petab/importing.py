"""The description of a PEtab problem.

Parameters become constants, learned or fixed. What the conditions change becomes a `condition` where its values are
numbers, else an intermediate that chooses by the number of the experiment. Each combination of an observable with its
parameters is a channel; each condition is a trajectory, and replicates are further ones, so that each value counts.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import libsbml

from gbspec.imports.computing import NotConstantError, value_of
from gbspec.imports.description import Channel, Description, Imported, Quantity, Report
from gbspec.imports.formulas import (
    Formula,
    as_number,
    call,
    named,
    names,
    number,
    replaced,
    spelled_number,
)
from gbspec.imports.petab.conditions import Conditions
from gbspec.imports.petab.courses import Courses, uses_time
from gbspec.imports.petab.networks import Networks, read_networks
from gbspec.imports.petab.problem import FILE, LINE, Row, Tables, files_of, read_document, read_first, rows_of, version
from gbspec.imports.petab.second import Second, read_second
from gbspec.imports.safety import refused
from gbspec.imports.sbml import Change, NotOfferedError, described_model, formula_of, read_model
from gbspec.imports.writing import model_name, written

DATA = "data.csv"
OPTIONS = {"forcing": "autoregressive"}
"""The objective of PEtab is that of whole solutions: measurements reset no state."""
_PREDICTION = " prediction"
"""After the name of an observable: the prediction, in its noise. No quantity is named so."""
Key: TypeAlias = tuple[str, str, str, str]
"""An observable, its parameters and those of its noise, and the change at whose time it is measured."""


def import_petab(path: Path) -> Imported:
    """The description of a problem of PEtab 1 or 2, and its table.

    Raises `UserError`: GB894 if a file is not read, GB895 with everything that cannot be expressed."""
    document, report = read_document(path), Report(str(path))
    kind = version(document)
    if kind not in ("1", "2"):
        raise refused(path, f"PEtab {document['format_version']} is not offered; PEtab 1 and 2 are")
    tables, second = (read_first(path, document), Second()) if kind == "1" else read_second(path, document)
    model = read_model(tables.model, report).getModel()
    problem = _Problem(path, tables, model, report, second)
    change = problem.change()
    made = described_model(model, report, tables.model, change)
    _check_noise(made, report)
    _check_times(made, second, report)
    made.name = model_name(path.stem)
    made.source = path.name
    report.raise_if_refused()
    columns = written(made).columns
    return Imported(made, tuple(report.left_out), {DATA: problem.table(columns)}, OPTIONS)


def _check_times(made: Description, second: Second, report: Report) -> None:
    """The table's times count from the start of each experiment, which is 0 in the model."""
    late = [name for name, start in second.starts.items() if start]
    for name in late:
        if uses_time(made):
            report.refuse(f"experiment {name}", 0, "it begins at another time than 0, and the model contains the time")
        else:
            report.omit(f"experiment {name}", 0, f"its start, {second.starts[name]:g}: times count from it")


def _check_noise(made: Description, report: Report) -> None:
    """Refuses noises of something else than constants and the prediction, and those that are no numbers where a
    trajectory begins at a steady state or something happens in it."""
    constants = {one.id for one in made.constants if not one.condition}
    learned = {one.id for one in made.constants if one.learn}
    there = {"pre-equilibration": made.rest is not None, "events and changes during an experiment": bool(made.events)}
    beside = [what for what, given in there.items() if given]
    for channel in made.channels:
        others = set() if channel.noise is None else names(channel.noise[1]) - constants - {channel.id}
        for name in sorted(others):
            report.refuse(f"observable {channel.id}", 0, f"a noise that depends on `{name}` is not offered yet")
        used = set() if channel.noise is None else names(channel.noise[1])
        reasons = [(f"on the estimated `{name}`", "; its `estimate` could be 0") for name in sorted(used & learned)]
        reasons += [("on the prediction", "")] if channel.id in used else []
        for (reason, advice), what in itertools.product(reasons, beside):
            text = f"a noise that depends {reason} is not offered yet beside {what}{advice}"
            report.refuse(f"observable {channel.id}", 0, text)


def _numbered(name: str, number_of: int, taken: Callable[[str], bool]) -> str:
    """A name with a number, the first from `number_of` on with which it is not taken."""
    while taken(label := f"{name}_{number_of}"):
        number_of += 1
    return label


@dataclass
class _Problem:
    path: Path
    tables: Tables
    model: libsbml.Model
    report: Report
    second: Second
    constants: dict[str, Quantity] = field(default_factory=dict)
    assigned: dict[str, Formula] = field(default_factory=dict)
    starts: dict[str, Formula] = field(default_factory=dict)
    channels: dict[Key, Channel] = field(default_factory=dict)
    experiment: str = "experiment"
    """The name of the number of the condition."""

    def __post_init__(self) -> None:
        while self._named(self.experiment):
            self.experiment += "_"

    def _named(self, name: str) -> bool:
        """Whether the problem has something of this name."""
        tables = (self.tables.observables, "observableId"), (self.tables.parameters, "parameterId")
        known = any(row.get(column, "") == name for rows, column in tables for row in rows)
        return known or self.model.getElementBySId(name) is not None

    def change(self) -> Change:
        """What the problem says of its model."""
        networks = self._networks()
        for row in self.tables.parameters:
            if row.get("parameterId", "") not in networks.scopes:
                self._parameter(row)
        self.conditions = self._conditions()
        self.values = self.conditions.values
        self._hybrid(networks)
        self.courses = Courses(self.second, self.values, self.experiment, self._formula)
        for row in self.tables.measurements:
            self._measured(row)
        happenings = self.courses.happenings(self.constants)
        channels = tuple(self.channels.values())
        return Change(self.constants, self.assigned, self.starts, happenings, channels, self.conditions.rest)

    def _conditions(self) -> Conditions:
        made = Conditions(
            self.tables, self.model, self.second, self.report, self.experiment, self.constants, self._formula
        )
        made.read()
        self.assigned |= made.assigned
        self.starts |= made.starts
        return made

    # ------------------------------------------------------------------------------------------------------ networks
    def _networks(self) -> Networks:
        """The networks of PEtab-SciML; without any where the problem has none."""
        if not self.second.sciml:
            return Networks()
        rows = rows_of(files_of(self.path, self.second.sciml.get("hybridization_files")))
        return read_networks(self.path, self.second, rows, parsed)

    def _hybrid(self, networks: Networks) -> None:
        """What networks add: weights, units, inputs from arrays, and the quantities that they set."""
        for weight in networks.weights:
            row = networks.governing(weight, self.tables.parameters)
            if row is not None:
                text = row.get("nominalValue", "")
                value = spelled_number(weight.value) if text in ("", "array") else text
                self._parameter({**row, "parameterId": weight.name, "nominalValue": value})
            else:
                self.constants[weight.name] = Quantity(weight.name, number(weight.value))
        self.assigned |= networks.lets
        for name, text in networks.hybrid.items():
            formula = parsed(text)
            if self.model.getSpecies(name) is not None:
                self.starts[name] = formula
            else:
                self.assigned[name] = formula
                self.constants.pop(name, None)
        for name, numbers in networks.arrays.items():
            if "0" in numbers:
                self.constants[name] = Quantity(name, number(numbers["0"]))
                continue
            self.constants[name] = Quantity(name, None, condition=True)
            for experiment, row in self.values.items():
                here = [numbers[one] for one in self.second.conditions.get(experiment, ()) if one in numbers]
                if len(here) != 1:
                    self.report.refuse(f"experiment {experiment}", 0, f"`{name}` has no value, or several")
                row[name] = spelled_number(here[0] if here else 0.0)

    # ---------------------------------------------------------------------------------------------------- parameters
    def _parameter(self, row: Row) -> None:
        name, value = row.get("parameterId", ""), _number(row.get("nominalValue", ""))
        estimated = row.get("estimate", "1") in ("1", "1.0", "true", "True")
        low, high = _number(row.get("lowerBound", "")), _number(row.get("upperBound", ""))
        if value is None:
            value = (low + high) / 2 if low is not None and high is not None else None
        if value is None:
            self._refuse(f"parameter {name}", row, "it has no nominal value")
            return
        bounds, span = "", None
        if estimated and low is not None and high is not None and not low <= value <= high:
            self._omit(f"parameter {name}", row, "the bounds do not hold the nominal value; they were widened to it")
        if estimated and low is not None and high is not None and low < high:
            span = min(low, value), max(high, value)
            bounds = f"in [{spelled_number(span[0])}, {spelled_number(span[1])}]"
        clauses = " ".join(part for part in (bounds, self._prior(row, estimated)) if part)
        description = row.get("parameterName", "")
        said, learn = description if description != name else "", clauses if estimated else None
        self.constants[name] = Quantity(name, number(value), said, learn=learn, range=span)
        if estimated and row.get("parameterScale", "lin") != "lin":
            reason = f"the scale {row['parameterScale']}: the scale of a learnable follows from its bounds"
            self._omit(f"parameter {name}", row, reason)
        for key in ("initializationPriorType", "initializationPriorParameters"):
            if row.get(key):
                self._omit(f"parameter {name}", row, f"`{key}`: a search draws starts from the bounds")

    def _prior(self, row: Row, estimated: bool) -> str:
        kind = row.get("objectivePriorType", "")
        found = [_number(text) for text in row.get("objectivePriorParameters", "").split(";")]
        scale = row.get("parameterScale", "") or "lin"
        known = [one for one in found if one is not None]
        if not estimated or not kind or (kind.lower().endswith("uniform") and not self._narrow(row, kind, known)):
            return ""
        on_scale = kind == "parameterScaleNormal"
        if len(known) == 2 and (kind == "normal" or (on_scale and scale == "lin")):
            return f"prior normal({spelled_number(known[0])}, {spelled_number(known[1])})"
        unit = math.log(10) if on_scale and scale == "log10" else 1.0
        low = _number(row.get("lowerBound", ""))
        logarithmic = kind == "logNormal" or (on_scale and scale in ("log", "log10"))
        if len(known) == 2 and logarithmic and (low is None or low >= 0):
            # The language states the median and the coefficient of variation.
            median, spread = math.exp(known[0] * unit), known[1] * unit
            return f"prior lognormal({spelled_number(median)}, {spelled_number(math.sqrt(math.expm1(spread**2)))})"
        self._omit(f"parameter {row.get('parameterId', '')}", row, f"the prior `{kind}` on the scale {scale}")
        return ""

    @staticmethod
    def _narrow(row: Row, kind: str, known: list[float]) -> bool:
        """Whether a uniform prior says more than the bounds."""
        low, high = (_number(row.get(name, "")) for name in ("lowerBound", "upperBound"))
        base = {"log": math.e, "log10": 10.0}.get(row.get("parameterScale", ""))
        if kind.startswith("parameterScale") and base is not None:
            known = [base**value for value in known]
        if len(known) != 2:
            return False
        slack = 1e-9 * max(map(abs, known))
        return low is None or high is None or known[0] > low + slack or known[1] < high - slack

    # --------------------------------------------------------------------------------------------------- observables
    def _measured(self, row: Row) -> None:
        """A measurement: its channel is declared when it is first met."""
        name = row.get("observableId", "")
        if math.isnan(_time(row)):
            self._refuse(f"measurement of {name}", row, "its time is no number")
        if _number(row.get("measurement", "")) is None:
            self._refuse(f"measurement of {name}", row, "it has no value")
        key = self._key(row)
        if key in self.channels:
            return
        observable = next((one for one in self.tables.observables if one.get("observableId") == name), None)
        if observable is None:
            self._refuse(f"observable {name}", row, "no table has it")
            return
        table = self._placeholders("observableParameter", name, row.get("observableParameters", ""))
        table |= self._placeholders("noiseParameter", name, row.get("noiseParameters", ""))
        for kind in ("observable", "noise"):
            given = row.get(f"{kind}Parameters", "").split(";")
            holders = observable.get(f"{kind}Placeholders", "").split(";")
            table |= {k.strip(): self._value(v.strip()) for k, v in zip(holders, given, strict=False) if k and v}
        try:
            now = self.courses.values_at(key[3]) if key[3] else {}
            value = replaced(replaced(parsed(observable.get("observableFormula", "")), table), now)
            own = {name: named(name + _PREDICTION)} if name not in table else {}
            sd = replaced(replaced(parsed(observable.get("noiseFormula", "")), table | own), now)
        except NotOfferedError as problem:
            self._refuse(f"observable {name}", observable, str(problem))
            return
        label = self._label(name, sum(one[0] == name for one in self.channels))
        # In the noise of a channel its own name is the prediction.
        own = {name + _PREDICTION: named(label)}
        own |= {value.name: named(label)} if value.head == "name" else {}
        noise = self._noise(observable, replaced(sd, own))
        self.channels[key] = Channel(label, value, label, noise)

    def _label(self, name: str, before: int) -> str:
        """The channel of an observable that has channels `before`: its own name first, then one that nothing else in
        the problem has."""
        if not before:
            return name
        channels = {one.id for one in self.channels.values()}
        return _numbered(name, before + 1, lambda label: label in channels or self._named(label))

    def _noise(self, row: Row, sd: Formula) -> tuple[str, Formula] | None:
        name = f"observable {row.get('observableId', '')}"
        if row.get("noiseDistribution", "normal") not in ("", "normal"):
            self._refuse(name, row, f"the noise `{row['noiseDistribution']}` is not offered yet")
        scale = {"": None, "lin": None, "log": 1.0, "log10": math.log(10)}.get(
            row.get("observableTransformation", ""), 0.0
        )
        if scale is None:
            return "normal", _plain(sd)
        if scale == 0.0:
            self._refuse(
                name, row, f"the transformation `{row['observableTransformation']}` has no form in the language"
            )
        # The language states the coefficient of variation: sd of the logarithm = sqrt(log(1 + cv^2)).
        log_sd = sd if scale == 1.0 else sd * number(scale)
        return "lognormal", _plain(call("sqrt", Formula("-", (call("exp", log_sd ** number(2)), number(1)))))

    def _placeholders(self, kind: str, name: str, text: str) -> dict[str, Formula]:
        found = {}
        for i, part in enumerate(one.strip() for one in text.split(";")):
            if part:
                found[f"{kind}{i + 1}_{name}"] = self._value(part)
        return found

    def _value(self, text: str) -> Formula:
        value = _number(text)
        return named(text) if value is None else number(value)

    def _formula(self, text: str, what: str, row: Row) -> Formula | None:
        try:
            return parsed(text)
        except NotOfferedError as problem:
            self._refuse(what, row, str(problem))
            return None

    def _key(self, row: Row) -> Key:
        """Measurements of one channel; those at the time of a change are of the values after it."""
        switch = self.courses.at(row["simulationConditionId"], _number(row.get("time", "")))
        return row.get("observableId", ""), row.get("observableParameters", ""), row.get("noiseParameters", ""), switch

    # --------------------------------------------------------------------------------------------------- measurements
    def table(self, columns: dict[str, str]) -> str:
        """The measurements as a wide table; replicates are trajectories of their own."""
        cells: dict[tuple[str, int], dict[float, dict[str, str]]] = {}
        for row in self.tables.measurements:
            condition, time = self.conditions.course_of(row).name, _time(row)
            time = 0.0 if math.isinf(time) else time - self.second.starts.get(row["simulationConditionId"], 0.0)
            column = columns[self.channels[self._key(row)].id]
            replicate = 0
            while column in cells.get((condition, replicate), {}).get(time, {}):
                replicate += 1
            cells.setdefault((condition, replicate), {}).setdefault(time, {})[column] = row["measurement"]
        conditions = [q.id for q in self.constants.values() if q.condition]
        measured = [columns[one.id] for one in self.channels.values()]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["trajectory", "t", *measured, *conditions])
        taken = {condition for condition, _ in cells}
        for (condition, replicate), rows in cells.items():
            label = condition if not replicate else _numbered(condition, replicate + 1, taken.__contains__)
            taken.add(label)
            own = [self.values[condition].get(name, "") for name in conditions]
            for time in sorted(rows):
                writer.writerow([label, spelled_number(time), *(rows[time].get(c, "") for c in measured), *own])
        return out.getvalue()

    def _refuse(self, element: str, row: Row | None, reason: str) -> None:
        where = "" if row is None else f"{row[FILE]}, "
        self.report.refuse(f"{where}{element}", 0 if row is None else int(row[LINE]), reason)

    def _omit(self, element: str, row: Row, reason: str) -> None:
        self.report.omit(f"{row[FILE]}, {element}", int(row[LINE]), reason)


def _number(text: str) -> float | None:
    """The number of a cell; None for a name, an empty cell, and what is not a finite number."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _time(row: Row) -> float:
    """The time of a measurement, which may be infinite; NaN for what is no number."""
    try:
        return float(row.get("time", ""))
    except ValueError:
        return math.nan


def _plain(formula: Formula) -> Formula:
    """A formula of numbers as a number."""
    try:
        return number(value_of(formula, {}))
    except NotConstantError:
        return formula


def parsed(text: str) -> Formula:
    """A formula in infix notation, as PEtab writes it: `log` is the natural logarithm. Raises `NotOfferedError`."""
    settings = libsbml.L3ParserSettings()
    settings.setParseLog(libsbml.L3P_PARSE_LOG_AS_LN)
    node = libsbml.parseL3FormulaWithSettings(text.replace("**", "^"), settings) if len(text) < 100_000 else None
    if node is None:
        raise NotOfferedError(f"the formula `{text[:60]}` cannot be read")
    return as_number(formula_of(node))
