"""Base points at which a question is expanded: within the declared ranges, at least one for each branch that they show.

A point has values of all variables (states, conditions, inputs, amounts of doses, time) and of the constants, which are
the same at every point of one order. Points at known values of unknowns, and points at which two applications of one
have equal arguments, tie what would else be independent. Where conditions or inputs choose among formulas, points with
different formulas and equal arguments are expanded together: several trajectories show one and the same function.
Branches that no point of the ranges shows, and that the ranges do not exclude, get points that are not certain: they
may raise a doubt about what others say, never decide.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Condition, Input, Range
from gbspec.passes.identifiability.branches import Branches, Choice
from gbspec.passes.identifiability.jets import Base
from gbspec.passes.identifiability.question import Question
from gbspec.passes.identifiability.starts import before_dose, begin, values_of
from gbspec.passes.identifiability.ties import agreed, ties

CANDIDATES = 600
"""Points drawn in search of branches."""

FEW = 16
"""Points drawn where there are none: the first at which all expressions have values is taken."""

MOST_SPECIAL = 12
"""The maximal number of values of a condition or an input by the numbers that it is compared with."""

MOST_CHOICES = 10
"""The maximal number of combinations of branches that get a point of their own."""

MOST_UNREACHED = 40
"""The maximal number of combinations with branches that no point has shown."""

MOST_BESIDE = 5
"""The maximal number of base points beside another one; where there are more, they come in several parts."""


@dataclass(frozen=True)
class _Drawn:
    """Values of every symbol at all candidates, and the widths of the variables."""

    values: dict[sympy.Symbol, Array]
    widths: dict[sympy.Symbol, Array]


def bases_of(question: Question, branches: Branches, rng: np.random.Generator) -> Iterator[Base]:
    """The base points, the generic one first."""
    constants = _constants(question, rng)
    count = CANDIDATES if branches.atoms else FEW
    drawn = _draw(question, constants, count, rng)
    every = branches.choices(drawn.values, count)
    first: dict[Choice, int] = {}
    for k, choice in enumerate(every):
        if choice is not None:
            first.setdefault(choice, k)
    if not first:
        generic: Choice = (0,) * len(branches.atoms)
        yield _base(question, drawn, 0, constants)
    else:
        generic = next(iter(first))
    kept = _kept(list(first))
    for choice in kept:
        yield _base(branches.resolved(choice), drawn, first[choice], constants)
    if branches.signals:
        yield from _together(question, branches, drawn, {choice: first[choice] for choice in kept}, constants)
    start = first.get(generic, 0)
    yield from ties(question, branches, _base(question, drawn, start, constants))
    shown = kept or [generic]
    for choice in islice(branches.unreached(shown), MOST_UNREACHED):
        doubt = _base(branches.resolved(choice), drawn, start, constants, certain=False)
        yield doubt
        if branches.by_signals(choice, shown):
            yield replace(doubt, beside=(_base(branches.resolved(generic), drawn, start, constants),))
    if (question.signals or branches.signals) and any(given is not None for given in question.starts):
        yield from _later(question, constants, rng)


def _later(question: Question, constants: dict[sympy.Symbol, float], rng: np.random.Generator) -> Iterator[Base]:
    """Points at a later time: signals that change may lead from a known start to states that constant ones do not, and
    trajectories with other formulas to the same states."""
    free = replace(question, starts=(None,) * len(question.starts))
    branches = Branches(free)
    count = CANDIDATES if branches.signals else FEW
    drawn = _draw(free, constants, count, rng)
    first: dict[Choice, int] = {}
    for index, choice in enumerate(branches.choices(drawn.values, count)):
        if choice is not None:
            first.setdefault(choice, index)
    for choice in islice(first, 1 if question.signals else 0):
        yield _base(branches.resolved(choice), drawn, first[choice], constants, certain=False)
    if branches.signals:
        kept = {choice: first[choice] for choice in _kept(list(first))}
        for base in _together(free, branches, drawn, kept, constants):
            yield replace(base, certain=False)


def _together(
    question: Question,
    branches: Branches,
    drawn: _Drawn,
    first: Mapping[Choice, int],
    constants: dict[sympy.Symbol, float],
) -> Iterator[Base]:
    """Base points with those beside them: the same functions, seen by trajectories with other formulas."""
    told: set[frozenset[Choice]] = set()
    for choice, index in first.items():
        base = _base(branches.resolved(choice), drawn, index, constants)
        others = _others(question, branches, drawn, index, constants)
        others.pop(choice, None)
        every = frozenset((choice, *others))
        if not others or every in told:
            continue
        told.add(every)
        yield from (other for found, other in others.items() if found not in first)
        beside = [each for other in others.values() for each in agreed(question, branches, base, other)]
        for k in range(0, len(beside), MOST_BESIDE):
            yield replace(base, beside=tuple(beside[k : k + MOST_BESIDE]))


def _others(
    question: Question, branches: Branches, drawn: _Drawn, index: int, constants: dict[sympy.Symbol, float]
) -> dict[Choice, Base]:
    """A base point for each choice of formulas that other conditions and inputs make at the states of a point; such
    that unknowns do not depend on them first."""
    inside = {symbol for a in question.applications for argument in a.arguments for symbol in argument.free_symbols}
    found: dict[Choice, Base] = {}
    for varied in dict.fromkeys((branches.signals - inside, branches.signals)):
        values = {
            symbol: value if symbol in varied else np.full(len(value), value[index])
            for symbol, value in drawn.values.items()
        }
        for dose in question.doses:
            state = question.model.states[dose.state].symbol
            values[state] = values[before_dose(state)]
        begin(question, values)
        widths = {
            symbol: width if symbol in varied else np.full(len(width), width[index])
            for symbol, width in drawn.widths.items()
        }
        there = _Drawn(values, widths)
        for k, choice in enumerate(branches.choices(values, len(values[question.model.time.symbol]))):
            if choice is not None and choice not in found:
                found[choice] = _base(branches.resolved(choice), there, k, constants)
    return found


def _kept(choices: Sequence[Choice]) -> list[Choice]:
    """At most `MOST_CHOICES` of them; those that show a new argument or branch first."""
    seen: set[tuple[int, int]] = set()
    new: list[Choice] = []
    others: list[Choice] = []
    for choice in choices:
        fresh = set(enumerate(choice)) - seen
        (new if fresh or not choice else others).append(choice)
        seen |= fresh
    return [*new, *others[: max(0, MOST_CHOICES - len(new))]]


def _constants(question: Question, rng: np.random.Generator) -> dict[sympy.Symbol, float]:
    constants = {c.symbol: c.value for c in question.model.constants}
    for learnable in question.model.learnables:
        low, high = learnable.range.low, learnable.range.high
        value = float(rng.uniform(0.6, 1.4)) * (learnable.start or 0.7)
        constants[learnable.symbol] = value if low < value < high else learnable.start
    return constants


def _draw(question: Question, constants: Mapping[sympy.Symbol, float], count: int, rng: np.random.Generator) -> _Drawn:
    model = question.model
    values: dict[sympy.Symbol, Array] = {s: np.full(count, v) for s, v in constants.items()}
    widths: dict[sympy.Symbol, Array] = {}
    special = _compared(question)
    signals: tuple[Condition | Input, ...] = (*model.conditions, *model.inputs)
    for item in signals:
        values[item.symbol], widths[item.symbol] = _column(item.range, item.default, count, rng)
        if isinstance(item, Condition) and item.categories:
            values[item.symbol], widths[item.symbol] = (
                rng.permutation(np.arange(count) % len(item.categories)).astype(float),
                0 * values[item.symbol],
            )
            continue
        numbers = special.of(item)
        step = max(4, len(numbers) + 1)
        for k, (number, width) in enumerate(numbers):
            values[item.symbol][k + 1 :: step], widths[item.symbol][k + 1 :: step] = number, width
    for dose in question.doses:
        given = model.states[dose.state].range
        size = given.high - max(given.low, 0.0) if given is not None and given.bounded else 2.0
        values[dose.amount] = size * rng.uniform(0.1, 0.9, count)
        widths[dose.amount] = values[dose.amount]
    time = model.time.symbol
    values[time], widths[time] = _column(None, None, count, rng)
    if model.time.start is not None:
        # From a free start any state may come at any later time; from a known one only what the start leads to.
        later = 0.0 if any(start is not None for start in question.starts) else 1.0
        values[time] = model.time.start + later * np.abs(values[time])
    for application in question.applications:
        values[application.value] = rng.uniform(0.2, 2.0, count) * rng.choice([1.0, 1.0, -1.0], count)
    for state in model.states:
        values[state.symbol], widths[state.symbol] = _column(state.range, state.start, count, rng)
    begin(question, values)
    return _Drawn(values, widths)


def _column(given: Range | None, guess: float | None, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Values within a range (without one: of size 1, and of any size), and the widths of small changes there."""
    low, high = (-np.inf, np.inf) if given is None else (given.low, given.high)
    if np.isfinite(low) and np.isfinite(high):
        size = high - low
        share = rng.uniform(0.02, 0.98, count)
        share[0] = rng.uniform(0.3, 0.7)
        return low + size * share, np.full(count, 0.25 * size) if size > 0 else np.zeros(count)
    center = 1.0 if guess is None or guess == 0 else guess
    near = center * rng.uniform(0.5, 1.5, count)
    wide = rng.choice([1.0, 1.0, -1.0], count) * 10 ** rng.uniform(-2, 4, count)
    values = np.where(np.arange(count) < count // 4, near, wide)
    if np.isfinite(low):
        values = low + np.abs(values)
    elif np.isfinite(high):
        values = high - np.abs(values)
    return values, np.abs(values)


@dataclass(frozen=True)
class _Compared:
    """The numbers that conditions and inputs are compared with: for equality, as with that of a category, or as
    thresholds."""

    equal: dict[sympy.Symbol, set[float]]
    thresholds: dict[sympy.Symbol, set[float]]

    def of(self, item: Condition | Input) -> list[tuple[float, float]]:
        """Values with widths: the numbers themselves, and the middles of what thresholds divide the range into."""
        found = [(number, 0.0) for number in sorted(self.equal.get(item.symbol, ()))]
        low, high = (-np.inf, np.inf) if item.range is None else (item.range.low, item.range.high)
        inside = sorted(t for t in self.thresholds.get(item.symbol, ()) if low < t < high)
        if inside:
            below, above = (abs(t) or 1.0 for t in (inside[0], inside[-1]))
            ends = [max(low, inside[0] - below), *inside, min(high, inside[-1] + above)]
            found += [((a + b) / 2, (b - a) / 4) for a, b in pairwise(ends)]
        return found[:MOST_SPECIAL]


def _compared(question: Question) -> _Compared:
    """The comparisons of single symbols with known numbers."""
    found = _Compared({}, {})
    known = {c.symbol: sympy.Float(c.value) for c in question.model.constants}
    for expression in Branches(question).expressions:
        for comparison in expression.atoms(sympy.core.relational.Relational):
            table = found.equal if isinstance(comparison, sympy.Eq | sympy.Ne) else found.thresholds
            for one, other in (comparison.args, comparison.args[::-1]):
                number = other.xreplace(known)
                if one.is_Symbol and number.is_number:
                    table.setdefault(one, set()).add(float(number))
    return found


def _base(
    question: Question, drawn: _Drawn, index: int, constants: dict[sympy.Symbol, float], *, certain: bool = True
) -> Base:
    model = question.model
    variables, widths = {}, {}
    free = [s.symbol for s, start in zip(model.states, question.starts, strict=True) if start is None]
    others = [
        *(c.symbol for c in model.conditions),
        *(i.symbol for i in model.inputs),
        *(d.amount for d in question.doses),
    ]
    if model.time.start is None:
        others.append(model.time.symbol)
    for symbol in (*free, *others, model.time.symbol):
        before = drawn.values.get(before_dose(symbol))
        variables[symbol] = float((drawn.values[symbol] if before is None else before)[index])
    for symbol in (*(s.symbol for s in model.states), *others):
        widths[symbol] = float(drawn.widths[symbol][index])
    here = {symbol: value[index : index + 1] for symbol, value in drawn.values.items()}
    begun = [s.symbol for s, start in zip(model.states, question.starts, strict=True) if start is not None]
    for symbol in begun:  # near a known start a state changes by its value there, however wide its range is
        widths[symbol] = min(abs(float(here[symbol][0])), widths[symbol]) or widths[symbol]
    rates = [abs(float(rate)) for rate in np.ravel([values_of(rate, here) for rate in question.rates])]
    quick = [r / widths[s.symbol] for r, s in zip(rates, model.states, strict=True) if widths[s.symbol] > 0]
    tempo = 1 / max(quick) if quick and 0 < max(quick) < np.inf else 1.0
    for rate, state in zip(rates, model.states, strict=True):
        if state.symbol in begun and not float(here[state.symbol][0]):
            widths[state.symbol] = min(rate * tempo, widths[state.symbol]) or widths[state.symbol]
    return Base(variables, constants, widths, question, certain, tempo)
