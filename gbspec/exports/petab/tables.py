"""The tables of a PEtab problem."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import sympy

from gbspec.backends import NotCoveredError
from gbspec.data import Trajectories, Trajectory, present_values
from gbspec.exports.petab.courses import Course, Lines
from gbspec.exports.sbml import Document
from gbspec.ir import NOISES, PREDICTION, Channel, Expr, Learnable

OBSERVABLE = "obs_"
"""Before the name of a channel: an observable cannot have the name of a quantity of the model."""


def table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> bytes:
    """A table of text."""
    out = io.StringIO()
    writer = csv.writer(out, delimiter="\t", lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return out.getvalue().encode()


def experiments(courses: Sequence[Course]) -> dict[str, bytes]:
    """The tables of conditions and experiments; equal periods share a condition."""
    known: dict[tuple[tuple[str, str], ...], str] = {}
    rows, conditions = [], []
    for course in courses:
        for time, period in sorted(course.periods.items()):
            key = tuple(period.items())
            if key and key not in known:
                known[key] = f"condition_{len(known) + 1}"
                conditions += [(known[key], target, value) for target, value in key]
            rows.append((course.name, "-inf" if math.isinf(time) else repr(time), known.get(key, "")))
    return {
        "conditions.tsv": table(("conditionId", "targetId", "targetValue"), conditions),
        "experiments.tsv": table(("experimentId", "time", "conditionId"), rows),
    }


def parameters(document: Document, learnables: Sequence[Learnable], more: Iterable[Sequence[str]] = ()) -> bytes:
    """The table of what is estimated; `more` are rows beside those of constants."""
    numbers = dict(zip(document.source.constant_names, document.exported.constants, strict=True))
    rows: list[Sequence[str]] = []
    for one in learnables:
        kind, given = "", ""
        if one.prior is not None and one.prior.kind == "normal":
            kind, given = "normal", f"{one.prior.location!r};{one.prior.scale!r}"
        elif one.prior is not None:
            spread = math.sqrt(math.log1p(one.prior.scale**2))
            kind, given = "log-normal", f"{math.log(one.prior.location)!r};{spread!r}"
        low, high = (repr(float(end)) for end in (one.range.low, one.range.high))
        name = document.names(one.name)
        rows.append((name, one.description, low, high, repr(float(numbers[one.name])), "true", kind, given))
    columns = ("parameterId", "parameterName", "lowerBound", "upperBound", "nominalValue", "estimate")
    return table((*columns, "priorDistribution", "priorParameters"), [*rows, *more])


class Observed:
    """The tables of observables and measurements."""

    def __init__(self, document: Document, data: Trajectories, lines: Mapping[str, Lines]) -> None:
        self._document, self._model = document, document.source
        self._data = present_values(self._model, data)

    def observables(self) -> bytes:
        """A row for each channel; a noise of the table is a placeholder."""
        rows = []
        for i, channel in enumerate(self._model.channels):
            name = self.name(channel)
            kind, noise = self._noise(channel, self._own_sd(i))
            holder = f"noiseParameter1_{name}" if self._own_sd(i) else ""
            value = self._formula(channel, channel.value)
            rows.append((name, channel.description or channel.name, value, noise, kind, "", holder))
        columns = ("observableId", "observableName", "observableFormula", "noiseFormula", "noiseDistribution")
        return table((*columns, "observablePlaceholders", "noisePlaceholders"), rows)

    def measurements(self, courses: Sequence[Course]) -> bytes:
        """A row for each value."""
        rows = []
        for course, item in zip(courses, self._data.items, strict=True):
            if item.limits is not None:
                raise NotCoveredError("the table has censored values, which PEtab cannot hold")
            if (item.counts > 1).any():
                raise NotCoveredError("the table has averages of several values at one time; give each its trajectory")
            for k, i in zip(*np.nonzero(np.isfinite(item.values)), strict=True):
                self._check(course, item, int(k), self._model.channels[i])
                noise = repr(float(item.sd[k, i])) if self._own_sd(i) else ""
                cells = (repr(float(item.times[k])), repr(float(item.values[k, i])), "", noise)
                rows.append((self.name(self._model.channels[i]), course.name, *cells))
        columns = ("observableId", "experimentId", "time", "measurement", "observableParameters", "noiseParameters")
        return table(columns, rows)

    def name(self, channel: Channel) -> str:
        """The id of an observable."""
        return OBSERVABLE + self._document.names(channel.name)

    def _own_sd(self, i: int) -> bool:
        """Whether the values of a channel have standard deviations of their own."""
        return any((item.sd[:, i] > 0).any() for item in self._data.items)

    def _noise(self, channel: Channel, own: bool) -> tuple[str, str]:
        """The distribution and the formula."""
        noise = channel.noise
        if own:
            if noise is not None:
                raise NotCoveredError(f"both the model and the table state the noise of `{channel.name}`")
            return "normal", f"noiseParameter1_{self.name(channel)}"
        if noise is None:
            raise NotCoveredError(f"neither the model nor the table states the noise of `{channel.name}`")
        if NOISES[noise.kind].density:
            whose = NOISES[noise.kind].whose
            raise NotCoveredError(f"the noise of `{channel.name}` is {whose}, which PEtab does not have")
        scale = sympy.Float(noise.scale) if noise.value is None else noise.value
        scale = scale.xreplace({PREDICTION: sympy.Symbol(self.name(channel), real=True)})
        if noise.kind == "normal":
            return "normal", self._formula(channel, scale)
        return "log-normal", self._formula(channel, sympy.sqrt(sympy.log(1 + scale**2)))

    def _formula(self, channel: Channel, value: Expr) -> str:
        """A formula of the tables, whose functions are fewer than those of SBML."""
        if value.has(sympy.floor):
            what = f"`{channel.name}` has `floor`, `ceil` or `mod`, which formulas of PEtab lack"
            raise NotCoveredError(f"{what}; name the value by `let`, which is in the SBML file")
        return self._document.infix(value)

    def _check(self, course: Course, item: Trajectory, k: int, channel: Channel) -> None:
        """PEtab measures after what a period sets, the language before a dose."""
        (value,) = self._model.inlined([channel.value])
        changed = course.arrivals.get(float(item.times[k]), set())
        if any(state.name in changed and state.symbol in value.free_symbols for state in self._model.states):
            raise NotCoveredError(
                f"`{channel.name}` is measured at the time of a dose, and so before it, where PEtab measures after it"
            )
