"""The files of a PEtab 2 problem as tables of the first version, with what that version lacks beside them.

An experiment whose conditions all apply at its start is a condition of PEtab 1. What applies later is a `Switch`, and
what applies before the start, until a steady state, is a condition of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gbspec.imports.petab.problem import FILE, LINE, Row, Tables, files_of, rows_of
from gbspec.imports.safety import refused

DEFAULT = "default"
"""The name of the experiment of measurements that name none."""
BEFORE = "_before"
"""After the name of an experiment: its condition before a steady state."""


@dataclass(frozen=True)
class Switch:
    """What an experiment changes at a time: the formulas of quantities, as text."""

    experiment: str
    time: float
    values: dict[str, str]
    row: Row


@dataclass(frozen=True)
class Second:
    """What PEtab 2 has beside the tables of the first version: starts of experiments, what they change later, and the
    part of the document for extensions."""

    starts: dict[str, float] = field(default_factory=dict)
    conditions: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """The conditions that apply when an experiment begins."""
    switches: tuple[Switch, ...] = ()
    mapping: tuple[Row, ...] = ()
    sciml: dict[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def changes(self, name: str) -> bool:
        """Whether something changes a quantity after the start."""
        return any(name in one.values for one in self.switches)


def read_second(path: Path, document: dict[str, Any]) -> tuple[Tables, Second]:
    """The tables of a document. Raises `UserError` (GB894)."""
    models = document.get("model_files")
    found = [one for one in (models.values() if isinstance(models, dict) else ()) if isinstance(one, dict)]
    if len(found) != 1:
        raise refused(path, "it has not exactly one model")
    if found[0].get("language") != "sbml":
        raise refused(path, f"its model is written in {found[0].get('language')!r}; SBML is offered")
    extensions = document.get("extensions")
    extensions = extensions if isinstance(extensions, dict) else {}
    for name in extensions:
        if name != "sciml":
            raise refused(path, f"the extension `{name}` is not offered")

    def rows(key: str) -> list[Row]:
        return rows_of(files_of(path, document.get(key)))

    measurements = [_measurement(row) for row in rows("measurement_files")]
    conditions, second = _experiments(
        path, rows("experiment_files"), rows("condition_files"), measurements, "sciml" in extensions
    )
    resting = {name for name in second.starts if name + BEFORE in second.conditions}
    measurements = [_after_rest(row) if row["simulationConditionId"] in resting else row for row in measurements]
    tables = Tables(
        files_of(path, [found[0].get("location")])[0],
        conditions,
        measurements,
        [_observable(row) for row in rows("observable_files")],
        [_parameter(row) for row in rows("parameter_files")],
    )
    sciml = extensions.get("sciml")
    second = replace(
        second,
        mapping=tuple(rows("mapping_files")),
        sciml=sciml if isinstance(sciml, dict) else {},
        folder=path.parent,
    )
    return tables, second


def _measurement(row: Row) -> Row:
    return {**row, "simulationConditionId": row.get("experimentId") or DEFAULT}


def _after_rest(row: Row) -> Row:
    return {**row, "preequilibrationConditionId": row["simulationConditionId"] + BEFORE}


def _observable(row: Row) -> Row:
    """The transformation follows from the noise, whose scale is that of the logarithm."""
    kind = row.get("noiseDistribution") or "normal"
    if kind == "log-normal":
        return {**row, "noiseDistribution": "normal", "observableTransformation": "log"}
    return {**row, "observableTransformation": "lin"}


def _parameter(row: Row) -> Row:
    prior = {
        "objectivePriorType": {"log-normal": "logNormal"}.get(
            row.get("priorDistribution", ""), row.get("priorDistribution", "")
        ),
        "objectivePriorParameters": row.get("priorParameters", ""),
    }
    return {**row, "parameterScale": "lin", **prior}


def _experiments(
    path: Path, experiments: list[Row], conditions: list[Row], measurements: Iterable[Row], sciml: bool
) -> tuple[list[Row], Second]:
    """A condition of PEtab 1 for each experiment, and what changes later."""
    targets: dict[str, dict[str, str]] = {}
    for row in conditions:
        targets.setdefault(row.get("conditionId", ""), {})[row.get("targetId", "")] = row.get("targetValue", "")
    periods: dict[str, dict[float, dict[str, str]]] = {}
    places: dict[str, Row] = {}
    applied: dict[tuple[str, float], list[str]] = {}
    for row in experiments:
        name, condition = row.get("experimentId", ""), row.get("conditionId", "")
        try:
            time = float(row.get("time", ""))
        except ValueError:
            raise refused(path, f"the time of the experiment `{name}` is no number", int(row[LINE])) from None
        if condition and condition not in targets and not sciml:
            raise refused(path, f"no table has the condition `{condition}`", int(row[LINE]))
        places.setdefault(name, row)
        periods.setdefault(name, {}).setdefault(time, {}).update(targets.get(condition, {}))
        applied.setdefault((name, time), []).append(condition)
    if any(row["simulationConditionId"] == DEFAULT for row in measurements):
        periods.setdefault(DEFAULT, {0.0: {}})
        places.setdefault(DEFAULT, {LINE: "0", FILE: path.name})
    found: list[Row] = []
    second = Second()
    for name, times in periods.items():
        order = sorted(times)
        row = places[name]
        place = {LINE: row[LINE], FILE: row[FILE]}
        if math.isinf(order[0]):
            found.append({"conditionId": name + BEFORE, **times[order.pop(0)], **place})
            second.conditions[name + BEFORE] = tuple(applied.get((name, -math.inf), ()))
        first, *later = order or [0.0]
        found.append({"conditionId": name, **times.get(first, {}), **place})
        second.starts[name] = first
        second.conditions[name] = tuple(applied.get((name, first), ()))
        switches = tuple(Switch(name, time, times[time], row) for time in later if times[time])
        second = replace(second, switches=(*second.switches, *switches))
    return found, second
