"""Cases of a model, read from `cases.toml`: how its data are simulated, its errors measured and its training set up.

A `cases.toml` in the folder of the model files has tables `[sampling]`, `[metrics]` and `[training]` for all models in
the folder, and a table `[case.NAME]` for each case that differs. A case with the name of a model (ignoring upper and
lower case) is the default case of that model.

Studies read any `cases.toml`; `validate` reads those of the bundled models only, since a run has a copy of its model
and does not know the model's folder.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gbspec.data.names import similar
from gbspec.data.overlays import Report, overlay
from gbspec.data.sampling import Box, SimulateOptions
from gbspec.diagnostics import Cell, Diagnostic, Findings, UserError
from gbspec.json_values import JsonObject

FILE = "cases.toml"
KEYS = ("title", "model", "data", "sampling", "metrics", "training", "published", "tables")
TABLES = ("eigenvalues", "initial-states")
Scalar = str | int | float | bool


@dataclass(frozen=True)
class MetricsOptions:
    """The points at which a model is compared with its truth.

    Solutions: from `conditions` sets of conditions (evenly over their ranges) times `points` points on the attractor,
    `spacing` apart in time (None: evenly over `period`, or over `horizon` without one) after
    `settle`, integrated over `horizon`. Right-hand sides and functions: `rhs_points` trajectories drawn as in
    `[sampling]`, one point of each at a time drawn evenly from `window`. `scales` normalises variables whose truth does
    not vary. None means: from the sampling (`settled` below).
    """

    settle: float | None = None
    horizon: float | None = None
    conditions: int = 50
    points: int = 20
    spacing: float | None = None
    period: float | None = None
    window: Box | None = None
    rhs_points: int = 1000
    scales: Mapping[str, float] = field(default_factory=dict)
    seed: int = 1

    def settled(self, span: float) -> MetricsOptions:
        """The options with defaults filled in for trajectories of length `span`, whose first fifth is dropped."""
        horizon = span / 2 if self.horizon is None else self.horizon
        return dataclasses.replace(
            self,
            settle=span / 5 if self.settle is None else self.settle,
            horizon=horizon,
            window=(span / 5, span) if self.window is None else self.window,
        )


@dataclass(frozen=True)
class TrainingDefaults:
    """The training options of a case: values for flags of `gbspec train`, by their names with underscores.

    `members` is the number of fits of the case in a study, each with its own seed; 0: none unless the case is named.
    """

    max_step: float | None = None
    effort: str = "normal"
    members: int = 10
    more: Mapping[str, Scalar] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """One case: a model, its sampling, metrics and training, and its `published` results (number by metric).

    `data` is the path of a table, if there is one; else data are simulated according to `sampling`. `tables` names the
    results of a study besides errors: `eigenvalues` (at the initial states) and `initial-states`.
    """

    name: str
    title: str
    model: Path | None
    data: Path | None = None
    sampling: SimulateOptions = field(default_factory=SimulateOptions)
    metrics: MetricsOptions = field(default_factory=MetricsOptions)
    training: TrainingDefaults = field(default_factory=TrainingDefaults)
    published: Mapping[str, float] = field(default_factory=dict)
    tables: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cases:
    """All cases of a folder; `base` has the defaults for all of them."""

    path: Path | None
    base: Case
    cases: tuple[Case, ...] = ()

    def case(self, name: str) -> Case:
        """The case of that name, ignoring upper and lower case; raises UserError (GB743) with the known ones."""
        for case in self.cases:
            if case.name.casefold() == name.casefold():
                return case
        known = [case.name for case in self.cases]
        meant = similar(name, known)
        advice = f"is `{meant}` meant?" if meant else f"there are {', '.join(known) or 'none'}"
        raise UserError([Diagnostic("GB743", f"there is no case `{name}`", _place(self.path), help=advice)])

    def of_model(self, model: str) -> Case:
        """The case with the name of the model, else the base."""
        for case in self.cases:
            if case.name.casefold() == model.casefold():
                return case
        return self.base


def find_cases(model_path: str | Path) -> Cases:
    """The cases in the folder of a model file; without a `cases.toml` there, only the defaults.

    Raises UserError if the file exists and has errors.
    """
    path = Path(model_path).parent / FILE
    if not path.is_file():
        return Cases(None, Case("", "", None))
    return load_cases(path)


def load_cases(path: str | Path) -> Cases:
    """Reads a `cases.toml`. Raises UserError with all errors in it (GB740 to GB742)."""
    path = Path(path)
    findings = Findings()
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError([Diagnostic("GB701", f"cannot read `{path}`: {error.strerror}", Cell(str(path)))]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError([Diagnostic("GB740", f"`{path}` is not valid TOML: {error}", Cell(str(path)))]) from error
    entries = document.pop("case", {})
    base = _Reader(path, findings, "").case(document, Case("", "", None))
    cases = []
    for name, entry in _Reader(path, findings, "").table({"case": entries}, "case").items():
        if not isinstance(entry, dict):
            _Reader(path, findings, "case.").table({name: entry}, name)
            continue
        cases.append(_Reader(path, findings, f"case.{name}.").case(entry, dataclasses.replace(base, name=name)))
    findings.raise_if_failed()
    return Cases(path, base, tuple(cases))


def _place(path: Path | None) -> Cell | None:
    return None if path is None else Cell(str(path))


class _Reader:
    """Converts tables to options; errors are reported with the key's full name, which begins with `prefix`."""

    def __init__(self, path: Path, findings: Findings, prefix: str) -> None:
        self.path, self.findings, self.prefix = path, findings, prefix

    def case(self, entry: JsonObject, base: Case) -> Case:
        """A case: the values of `entry`, with those of `base` as defaults."""
        for key in entry:
            if key not in KEYS:
                self.report("GB741", key, f"is not a known key; known are {', '.join(KEYS)}")
        return Case(
            name=base.name,
            title=self.text(entry, "title", base.title),
            model=self.model(self.text(entry, "model", base.name)) if base.name else None,
            data=self.data(self.text(entry, "data", "")) or base.data,
            sampling=self.sampling(self.table(entry, "sampling"), base.sampling),
            metrics=overlay(base.metrics, self.table(entry, "metrics"), self.within("metrics")),
            training=self.training(self.table(entry, "training"), base.training),
            published=overlay(_Published(), {"values": self.table(entry, "published")}, self.within("")).values,
            tables=self.tables(entry.get("tables", list(base.tables))),
        )

    def sampling(self, entry: JsonObject, base: SimulateOptions) -> SimulateOptions:
        """The options of `[sampling]`; `channels` may be a number."""
        if isinstance(entry.get("channels"), float):
            entry["channels"] = str(entry["channels"])
        options = overlay(base, entry, self.within("sampling"))
        wrong = Findings()
        options.check(wrong)
        for diagnostic in wrong:
            self.report("GB742", f"sampling.{diagnostic.subject}", diagnostic.message)
        return options

    def training(self, entry: JsonObject, base: TrainingDefaults) -> TrainingDefaults:
        """The options of `[training]`; keys that are not fields are kept, to be checked by the training."""
        own = {option.name for option in dataclasses.fields(TrainingDefaults)} - {"more"}
        known = {key: value for key, value in entry.items() if key.replace("-", "_") in own}
        more = {key.replace("-", "_"): value for key, value in entry.items() if key not in known}
        for key, value in more.items():
            if not isinstance(value, Scalar):
                self.report("GB742", f"training.{key}", f"must be a text, a number, true or false, not {value!r}")
        filled = overlay(base, known, self.within("training"))
        return dataclasses.replace(filled, more={**base.more, **more})

    def model(self, name: str) -> Path | None:
        """The case's model file, in the folder of the cases; without `model`, the one with the name of the case."""
        for file in (name, name.lower()):
            candidate = self.path.parent / f"{file}.gb"
            if candidate.is_file():
                return candidate
        self.report("GB742", "model", f"names no file: there is no `{name}.gb` in the folder of the cases")
        return None

    def tables(self, given: object) -> tuple[str, ...]:
        """The tables that a case requests."""
        if isinstance(given, list) and all(name in TABLES for name in given):
            return tuple(given)
        self.report("GB742", "tables", f"must be a list of {' and '.join(map(repr, TABLES))}, not {given!r}")
        return ()

    def data(self, name: str) -> Path | None:
        """The case's table, by its path from the folder of the cases; None without `data`."""
        candidate = self.path.parent / name
        if not name or candidate.is_file():
            return candidate if name else None
        self.report("GB742", "data", f"names no file: there is no `{name}` in the folder of the cases")
        return None

    def table(self, entry: JsonObject, key: str) -> JsonObject:
        """A table within `entry`; empty if there is none."""
        value = entry.get(key, {})
        if isinstance(value, dict):
            return dict(value)
        self.report("GB742", key, f"must be a table, not {value!r}")
        return {}

    def text(self, entry: JsonObject, key: str, default: str) -> str:
        """A text within `entry`."""
        value = entry.get(key, default)
        if isinstance(value, str):
            return value
        self.report("GB742", key, f"must be a text, not {value!r}")
        return default

    def within(self, section: str) -> Report:
        """A reporter for the keys of a section."""
        return lambda code, key, what: self.report(code, f"{section}.{key}" if section else "published", what)

    def report(self, code: str, key: str, what: str) -> None:
        """Records an error at a key."""
        self.findings.error(code, f"`{self.prefix}{key}` {what}", Cell(str(self.path)))


@dataclass(frozen=True)
class _Published:
    values: Mapping[str, float] = field(default_factory=dict)
