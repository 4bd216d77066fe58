"""Branches of a question: what `max`, `min`, `abs`, `sign`, `floor` and `if` choose at a point, and the formulas of it.

Each atom with branches has a choice at each point: the number of the argument or of the branch. A choice for every atom
makes the question smooth (`resolved`). Points are drawn within the declared ranges, so that the choices found are those
that data can show; `unreached` are choices that no point has shown and that intervals do not exclude.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Condition, Expr, Input, Lookup, State
from gbspec.passes.identifiability.question import Question
from gbspec.passes.identifiability.series import Algebra, Evaluation
from gbspec.passes.intervals import REAL, Box, Interval, enclosure, of_range

Choice = tuple[int, ...]
"""For each atom the number of its argument (`max`, `min`), of its branch (`if`), or 0 below zero and 1 above."""

Points = Mapping[sympy.Symbol, Array]

_KINDS = (sympy.Piecewise, sympy.Max, sympy.Min, sympy.Abs, sympy.sign, sympy.Heaviside, sympy.floor, Lookup)

_PIECES = (sympy.floor, Lookup)
"""Those of many pieces, whose formulas differ in numbers alone: they stay in the formulas."""

_STEPS = 3
"""So many successive steps of a `floor` get points of their own."""


class Branches:
    """The atoms with branches of a question, and their choices at points."""

    def __init__(self, question: Question) -> None:
        self.question = question
        found: set[Expr] = set()
        for expression in self.expressions:
            found |= expression.atoms(*_KINDS)
        self.atoms = tuple(sorted(found, key=sympy.default_sort_key))
        self._numbers = {atom: k for k, atom in enumerate(self.atoms)}

    @property
    def expressions(self) -> Iterator[Expr]:
        """All expressions of the question."""
        question = self.question
        yield from (*question.rates, *question.outputs, *(start for start in question.starts if start is not None))
        for application in question.applications:
            yield from application.arguments

    @cached_property
    def deciding(self) -> tuple[frozenset[sympy.Symbol], ...]:
        """For each atom the symbols that its choice depends on."""
        return tuple(frozenset(_decided_by(atom)) for atom in self.atoms)

    @cached_property
    def signals(self) -> frozenset[sympy.Symbol]:
        """The conditions and inputs, and the time where any state may come at any time, that choices depend on.

        Trajectories at the same states may differ in them; along a single trajectory there is nothing beside it.
        """
        question, model = self.question, self.question.model
        if question.alone:
            return frozenset()
        free = {s.symbol for s in (*model.conditions, *model.inputs)}
        if model.time.start is None or all(start is None for start in question.starts):
            free.add(model.time.symbol)
        return frozenset(free & {symbol for symbols in self.deciding for symbol in symbols})

    # ---------------------------------------------------------------- points
    def choices(self, points: Points, count: int) -> list[Choice | None]:
        """The choice of every atom at every point; None where an expression has no finite value."""
        at = evaluated(points, count)
        with np.errstate(all="ignore"):
            rows = [self._chosen(atom, at, count) for atom in self.atoms]
            finite = np.ones(count, dtype=bool)
            for rate in (*self.question.rates, *self.question.outputs):
                finite &= np.isfinite(at(rate)[..., 0])
        for row in rows:
            finite &= np.isfinite(row)
        return [tuple(int(row[k]) for row in rows) if finite[k] else None for k in range(count)]

    def _chosen(self, atom: Expr, at: Evaluation, count: int) -> Array:
        if isinstance(atom, sympy.Piecewise):
            chosen = np.full(count, len(atom.args) - 1)
            for k in range(len(atom.args) - 1, -1, -1):
                chosen = np.where(at.condition(atom.args[k][1]), k, chosen)
            return chosen
        values = np.stack([at(part)[..., 0] for part in atom.args])
        if isinstance(atom, sympy.Max | sympy.Min):
            return np.asarray(values.argmax(axis=0) if isinstance(atom, sympy.Max) else values.argmin(axis=0))
        if isinstance(atom, Lookup):
            return _part(atom, values)
        if isinstance(atom, sympy.floor):
            return np.asarray(np.mod(np.floor(values[0]), _STEPS))
        return np.asarray((values[0] > 0).astype(int))

    # ---------------------------------------------------------------- formulas
    def resolved(self, choice: Choice) -> Question:
        """The question with the formulas of one choice; without branches."""
        if not self.atoms:
            return self.question
        memo: dict[Expr, Expr] = {}

        def smooth(e: Expr) -> Expr:
            if e in memo or not e.args:
                return memo.get(e, e)
            if e in self._numbers and not isinstance(e, _PIECES):
                memo[e] = smooth(_picked(e, choice[self._numbers[e]]))
            elif e.has(*_KINDS):
                memo[e] = e.func(*(smooth(part) for part in e.args))
            else:
                memo[e] = e
            return memo[e]

        question = self.question
        return replace(
            question,
            rates=tuple(map(smooth, question.rates)),
            outputs=tuple(map(smooth, question.outputs)),
            starts=tuple(None if start is None else smooth(start) for start in question.starts),
            applications=tuple(replace(a, arguments=tuple(map(smooth, a.arguments))) for a in question.applications),
        )

    def unreached(self, reached: Sequence[Choice]) -> Iterator[Choice]:
        """Choices with an argument or branch that no point has shown, and that the ranges do not exclude: each beside
        what the points have shown of the others, then all that remain."""
        missing = {k: self._not_shown(k, atom, reached) for k, atom in enumerate(self.atoms)}
        further = {k: numbers for k, numbers in missing.items() if numbers}
        single = [{k: number} for k, numbers in further.items() for number in numbers]
        longest = max(map(len, further.values()), default=0)
        several = [{k: numbers[i % len(numbers)] for k, numbers in further.items()} for i in range(longest)]
        told: set[Choice] = set()
        for changes in (*single, *several):
            for choice in reached:
                other = tuple(changes.get(k, number) for k, number in enumerate(choice))
                if other not in told:
                    yield other
                told.add(other)

    def by_signals(self, choice: Choice, reached: Sequence[Choice]) -> bool:
        """Whether signals have a part in what no point has shown of a choice."""
        new = [k for k, number in enumerate(choice) if all(number != shown[k] for shown in reached)]
        return any(self.deciding[k] & self.signals for k in new)

    def _not_shown(self, k: int, atom: Expr, reached: Sequence[Choice]) -> list[int]:
        """The arguments or branches of an atom that no point has shown and that the ranges do not exclude."""
        if isinstance(atom, _PIECES):
            return []
        shown = {choice[k] for choice in reached}
        count = len(atom.args) if isinstance(atom, sympy.Piecewise | sympy.Max | sympy.Min) else 2
        return [other for other in range(count) if other not in shown and not self._excluded(atom, other)]

    def _excluded(self, atom: Expr, number: int) -> bool:
        """Whether the declared ranges prove that a branch is never taken (or, for equal arguments, need not be)."""
        if isinstance(atom, sympy.Piecewise):
            earlier = [sympy.Not(condition) for _, condition in atom.args[:number]]
            return any(_impossible(condition, self.box) for condition in (atom.args[number][1], *earlier))
        if isinstance(atom, sympy.Max | sympy.Min):
            side = 1 if isinstance(atom, sympy.Max) else -1
            rest = [part for i, part in enumerate(atom.args) if i != number]
            return any(_nonnegative(side * (part - atom.args[number]), self.box) for part in rest)
        return _nonnegative(atom.args[0] if number == 0 else -atom.args[0], self.box)

    @cached_property
    def box(self) -> Box:
        """The declared ranges of all symbols."""
        model = self.question.model
        box: dict[sympy.Symbol, Interval] = {k.symbol: of_range(k.range) for k in model.learnables}
        variables: tuple[State | Condition | Input, ...] = (*model.states, *model.conditions, *model.inputs)
        box.update({item.symbol: of_range(item.range) for item in variables})
        box.update({c.symbol: Interval(c.value, c.value) for c in model.constants})
        box.update({a.value: REAL for a in self.question.applications})
        if model.time.start is not None:
            box[model.time.symbol] = Interval(model.time.start, np.inf, False, True)
        return box


def evaluated(points: Points, count: int) -> Evaluation:
    """The evaluation of expressions at points, without any series: only the first coefficients."""
    algebra = Algebra(0, 0)
    table = {name: algebra.constant(np.broadcast_to(np.asarray(value), count)) for name, value in points.items()}
    return Evaluation(algebra, table, count)


def _decided_by(atom: Expr) -> set[sympy.Symbol]:
    """The symbols that the choice of an atom depends on."""
    deciding = [condition for _, condition in atom.args] if isinstance(atom, sympy.Piecewise) else atom.args
    return {symbol for part in deciding for symbol in part.free_symbols}


def _part(atom: Lookup, values: Array) -> Array:
    """In which quarter of the pieces of each argument the points lie: several points then tell what one piece does not.

    A table of a single piece, or the points beyond its ends, are no branches of their own.
    """
    found = np.zeros(values.shape[1])
    for places, x in zip(atom.curve.knots, values, strict=True):
        piece = np.clip(np.searchsorted(places, x) - 1, 0, len(places) - 2)
        found = 4 * found + piece * min(4, len(places) - 1) // (len(places) - 1)
    return np.asarray(found)


def _picked(atom: Expr, number: int) -> Expr:
    if isinstance(atom, sympy.Piecewise):
        return atom.args[number][0]
    if isinstance(atom, sympy.Max | sympy.Min):
        return atom.args[number]
    if isinstance(atom, sympy.Abs):
        return atom.args[0] if number else -atom.args[0]
    if isinstance(atom, sympy.sign):
        return sympy.Integer(1 if number else -1)
    return sympy.Integer(number)


def _nonnegative(expression: Expr, box: Box) -> bool:
    found = enclosure(sympy.expand(expression), box)
    return found is not None and found.nonnegative


def _impossible(condition: sympy.Basic, box: Box) -> bool:
    """Whether a condition is proved to be false everywhere in the box, but for single points."""
    if isinstance(condition, sympy.And):
        return any(_impossible(part, box) for part in condition.args)
    if isinstance(condition, sympy.Or):
        return all(_impossible(part, box) for part in condition.args)
    if isinstance(condition, sympy.StrictLessThan | sympy.LessThan):
        return _nonnegative(condition.lhs - condition.rhs, box)
    if isinstance(condition, sympy.StrictGreaterThan | sympy.GreaterThan):
        return _nonnegative(condition.rhs - condition.lhs, box)
    return bool(condition == sympy.false)
