"""Trajectories as experiments: what holds in the steady state before the start, from the start, and later.

A period begins at a time and sets quantities. Inputs that are held are set at each of their times; linear ones are
straight lines whose height, slope and time are set. Doses add to states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import sympy

from gbspec.backends import NotCoveredError
from gbspec.data import Trajectory
from gbspec.exports.sbml import Document
from gbspec.ir import Expr, symbol

Period = dict[str, str]
"""The formulas of what is set, by quantity."""


@dataclass
class Course:
    """The periods of an experiment by time, minus infinity for a steady state; and the times at which doses arrive,
    with the states that they change."""

    name: str
    periods: dict[float, Period] = field(default_factory=dict)
    arrivals: dict[float, set[str]] = field(default_factory=dict)

    def at(self, time: float) -> Period:
        """What is set at a time."""
        return self.periods.setdefault(time, {})


@dataclass(frozen=True)
class Lines:
    """The quantities of a linear input: `height + slope*(time - since)`."""

    height: str
    slope: str
    since: str


class Courses:
    """The experiments of a table; `starts` [N, n] are the measured and learned starts."""

    def __init__(self, document: Document, lines: Mapping[str, Lines], starts: np.ndarray) -> None:
        self._document, self._model, self._lines, self._starts = document, document.source, lines, starts

    def course(self, name: str, number: int, item: Trajectory) -> Course:
        """The experiment of one trajectory."""
        made = Course(name)
        begin = made.at(item.start)
        for condition, value in zip(self._model.conditions, item.condition, strict=True):
            begin[self._name(condition.name)] = repr(float(value))
        for i, state in enumerate(self._model.states):
            if not state.initial.known:
                begin[self._name(state.name)] = repr(float(self._starts[number, i]))
        self._inputs(made, item)
        self._steady(made, item)
        self._doses(made, item)
        return made

    def _name(self, name: str) -> str:
        return self._document.names(name)

    def _inputs(self, made: Course, item: Trajectory) -> None:
        for given, course in zip(self._model.inputs, item.inputs, strict=True):
            times, values = np.asarray(course.times, dtype=float), np.asarray(course.values, dtype=float)
            if given.interpolation == "held":
                first = max(int(np.searchsorted(times, item.start, side="right")) - 1, 0)
                made.at(item.start)[self._name(given.name)] = repr(float(values[first]))
                for time, value in zip(times[first + 1 :], values[first + 1 :], strict=True):
                    if time < item.end:
                        made.at(float(time))[self._name(given.name)] = repr(float(value))
                continue
            lines = self._lines[given.name]
            knots = [item.start, *(float(t) for t in times if item.start < t < item.end), item.end]
            heights = np.interp(knots, times, values)
            for k, (time, height) in enumerate(zip(knots[:-1], heights[:-1], strict=True)):
                slope = (heights[k + 1] - height) / (knots[k + 1] - time)
                made.at(time).update(
                    {lines.height: repr(float(height)), lines.slope: repr(float(slope)), lines.since: repr(float(time))}
                )

    # ------------------------------------------------------------------------------------------------ steady states
    def _steady(self, made: Course, item: Trajectory) -> None:
        steady = self._model.steady
        if steady is None:
            return
        own = {c.symbol: sympy.Float(v) for c, v in zip(self._model.conditions, item.condition, strict=True)}
        if steady.chosen is not None and not float(self._known(steady.chosen, own)) > 0:
            return
        if set(steady.states) != {i for i, state in enumerate(self._model.states) if not state.discrete}:
            raise NotCoveredError("a steady start of some of its states is none of the whole, as PEtab needs")
        if any(given.interpolation == "linear" for given in self._model.inputs):
            raise NotCoveredError("it has a steady start and an input that is linear between its times")
        begin = made.at(item.start)
        made.periods[-math.inf] = {
            **begin,
            **{self._name(name): self._formula(value, own) for name, value in steady.held},
        }
        names = [state.name for state in self._model.states]
        begin.update({self._name(names[place]): self._formula(value, own) for place, value in steady.after})

    def _known(self, value: Expr, own: Mapping[sympy.Symbol, Expr]) -> Expr:
        numbers = dict(zip(self._model.constant_names, self._document.exported.constants, strict=True))
        return value.xreplace({**own, **{symbol(k): sympy.Float(float(v)) for k, v in numbers.items()}})

    def _formula(self, value: Expr, own: Mapping[sympy.Symbol, Expr]) -> str:
        return self._document.infix(value.xreplace(dict(own)))

    # -------------------------------------------------------------------------------------------------------- doses
    def _doses(self, made: Course, item: Trajectory) -> None:
        own = {c.symbol: sympy.Float(v) for c, v in zip(self._model.conditions, item.condition, strict=True)}
        for dose, given in zip(self._model.doses, item.doses, strict=True):
            if not len(given.times):
                continue
            if dose.lag.free_symbols & {k.symbol for k in self._model.learnables}:
                raise NotCoveredError("the lag of its doses is learned, and times are numbers in PEtab")
            lag = float(self._known(dose.lag, own))
            name, fraction = self._name(dose.state), self._formula(dose.fraction, own)
            for time, amount in zip(given.times, given.amounts, strict=True):
                at = float(time) + lag
                if at > item.end:
                    continue
                if at < item.start:
                    raise NotCoveredError("it has doses before the start of a trajectory")
                period = made.at(at)
                before = period.get(name)
                if before is None:
                    before = self._start_of(dose.state) if at == item.start else name
                period[name] = f"{before} + {float(amount)!r}*({fraction})"
                made.arrivals.setdefault(at, set()).add(dose.state)

    def _start_of(self, name: str) -> str:
        """The formula of the start of a state that a dose changes there; after a steady state, the state itself."""
        state = next(s for s in self._model.states if s.name == name)
        if self._model.steady is not None:
            return self._name(name)
        others = [s.initial.value for s in self._model.states if s.initial.value is not None and s.name != name]
        if any(state.symbol in value.free_symbols for value in others):
            raise NotCoveredError(f"the start of another state depends on `{name}`, into which a dose is given there")
        if state.initial.value is None:
            return repr(float(state.start or 0.0))
        return f"({self._document.infix(state.initial.value)})"
