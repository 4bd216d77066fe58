"""Base points at which a question is expanded: within the declared ranges, at least one for each branch that they show.

A point has values of all variables (states, conditions, inputs, amounts of doses, time) and of the constants, which are
the same at every point of one order. Points at known values of unknowns, and points at which two applications of one
have equal arguments, tie what would else be independent. Branches that no point of the ranges shows, and that the
ranges do not exclude, get points that are not certain: they may raise a doubt about what others say, never decide.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Condition, Expr, Input, Range
from gbspec.passes.identifiability.branches import Branches, Choice, evaluated
from gbspec.passes.identifiability.jets import Base
from gbspec.passes.identifiability.question import Question
from gbspec.passes.identifiability.series import Algebra, Evaluation

CANDIDATES = 600
"""Points drawn in search of branches."""

FEW = 16
"""Points drawn where there are none: the first at which all expressions have values is taken."""

MOST_CHOICES = 10
"""The maximal number of combinations of branches that get a point of their own."""

MOST_UNREACHED = 40
"""The maximal number of combinations with branches that no point has shown."""

MOST_TIES = 6
"""The maximal number of points at which applications agree or vanish."""


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
    start = first.get(generic, 0)
    yield from _ties(question, branches, _base(question, drawn, start, constants))
    for choice in islice(branches.unreached(kept or [generic]), MOST_UNREACHED):
        yield _base(branches.resolved(choice), drawn, start, constants, certain=False)
    if question.signals and any(given is not None for given in question.starts):
        yield from _later(question, constants, rng)


def _later(question: Question, constants: dict[sympy.Symbol, float], rng: np.random.Generator) -> Iterator[Base]:
    """A point at a later time: signals that change may lead from a known start to states that constant ones do not."""
    free = replace(question, starts=(None,) * len(question.starts))
    branches = Branches(free)
    drawn = _draw(free, constants, FEW, rng)
    for index, choice in enumerate(branches.choices(drawn.values, FEW)):
        if choice is not None:
            yield _base(branches.resolved(choice), drawn, index, constants, certain=False)
            return


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
    special = _special(question)
    signals: tuple[Condition | Input, ...] = (*model.conditions, *model.inputs)
    for item in signals:
        values[item.symbol], widths[item.symbol] = _column(item.range, item.default, count, rng)
        if isinstance(item, Condition) and item.categories:
            values[item.symbol], widths[item.symbol] = (
                rng.permutation(np.arange(count) % len(item.categories)).astype(float),
                0 * values[item.symbol],
            )
            continue
        for k, number in enumerate(special.get(item.symbol, ())):
            values[item.symbol][k + 1 :: 4], widths[item.symbol][k + 1 :: 4] = number, 0.0
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
    for state, start in zip(model.states, question.starts, strict=True):
        values[state.symbol], widths[state.symbol] = _column(state.range, state.start, count, rng)
        if start is not None:
            values.pop(state.symbol)
    _follow(question, values)
    for dose in question.doses:
        symbol = model.states[dose.state].symbol
        added = _values(dose.fraction * dose.amount, values)
        values[_before(symbol)] = values[symbol]
        values[symbol] = values[symbol] + added
    return _Drawn(values, widths)


def _before(symbol: sympy.Symbol) -> sympy.Symbol:
    """The symbol of a state before a dose."""
    return sympy.Symbol(f"{symbol.name} before a dose", real=True)


def _follow(question: Question, values: dict[sympy.Symbol, Array]) -> None:
    """Adds the states whose start is an expression."""
    pairs = zip(question.model.states, question.starts, strict=True)
    waiting = {state.symbol: start for state, start in pairs if start is not None}
    while waiting:
        for symbol in [s for s, e in waiting.items() if not e.free_symbols & set(waiting)]:
            values[symbol] = _values(waiting.pop(symbol), values)


def _values(expression: Expr, values: Mapping[sympy.Symbol, Array]) -> Array:
    count = len(next(iter(values.values())))
    with np.errstate(all="ignore"):  # where an expression has no value, the point is left out later
        return evaluated(values, count)(expression)[..., 0]


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


def _special(question: Question) -> dict[sympy.Symbol, list[float]]:
    """Numbers with which a condition or an input is compared for equality, as with the number of a category."""
    found: dict[sympy.Symbol, list[float]] = {}
    for expression in (*question.rates, *question.outputs):
        for equality in expression.atoms(sympy.Eq, sympy.Ne):
            for one, other in (equality.args, equality.args[::-1]):
                if one.is_Symbol and other.is_number:
                    numbers = found.setdefault(one, [])
                    if float(other) not in numbers and len(numbers) < 3:
                        numbers.append(float(other))
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
        before = drawn.values.get(_before(symbol))
        variables[symbol] = float((drawn.values[symbol] if before is None else before)[index])
    for symbol in (*(s.symbol for s in model.states), *others):
        widths[symbol] = float(drawn.widths[symbol][index])
    here = {symbol: value[index : index + 1] for symbol, value in drawn.values.items()}
    rates = [abs(float(rate)) for rate in np.ravel([_values(rate, here) for rate in question.rates])]
    quick = [r / widths[s.symbol] for r, s in zip(rates, model.states, strict=True) if widths[s.symbol] > 0]
    tempo = 1 / max(quick) if quick and 0 < max(quick) < np.inf else 1.0
    return Base(variables, constants, widths, question, certain, tempo)


# ------------------------------------------------------------------------------------------------------ special points


def _ties(question: Question, branches: Branches, generic: Base) -> Iterator[Base]:
    """Points at known values of unknowns, and points at which two applications have equal arguments."""
    pairs: list[tuple[Sequence[Expr], Sequence[Expr]]] = []
    for application in question.applications:
        pairs += [([application.arguments[r]], [place]) for r, place, _ in application.known]
    for i, first in enumerate(question.applications):
        for second in question.applications[:i]:
            if first.unknown == second.unknown and len(pairs) < MOST_TIES:
                pairs.append((first.arguments, second.arguments))
    amounts = {dose.amount for dose in question.doses}
    undosed = replace(generic, variables={**generic.variables, **dict.fromkeys(amounts, 0.0)})
    for one, other in pairs:
        base = _agreeing(question, one, other, undosed, frozenset(amounts))
        if base is None and amounts:
            base = _agreeing(question, one, other, generic)
        if base is not None:
            yield _with_branches(question, branches, base)


def _with_branches(question: Question, branches: Branches, base: Base) -> Base:
    """The base with the formulas that hold at it."""
    values = {s: np.full(1, v) for s, v in (*base.constants.items(), *base.variables.items())}
    values.update((a.value, np.ones(1)) for a in question.applications)
    _follow(question, values)
    (choice,) = branches.choices(values, 1)
    here = question if choice is None else branches.resolved(choice)
    return Base(base.variables, base.constants, base.widths, here, base.certain, base.tempo)


def _agreeing(
    question: Question,
    first: Sequence[Expr],
    second: Sequence[Expr],
    generic: Base,
    held: AbstractSet[sympy.Symbol] = frozenset(),
) -> Base | None:
    """A point where expressions have the same values after doses, by Newton's method with minimum-norm steps; variables
    that are `held` stay."""
    values = {a.value for a in question.applications}
    expressions = [*first, *second]
    if any(e.free_symbols & values for e in expressions):
        return None
    clock = question.model.time.symbol
    names = [n for n in generic.variables if n not in held and (n != clock or question.model.time.start is None)]
    if not names and not held:  # everything is given: no other point exists
        return None
    sizes = np.array([generic.widths.get(n) or 1e-9 for n in names])
    point = np.array([generic.variables[n] for n in names])
    algebra = Algebra(0, 0)

    def gap(at: Array) -> Array:
        given = {**generic.variables, **dict(zip(names, at, strict=True)), **generic.constants}
        table = {n: algebra.constant(np.array([v])) for n, v in given.items()}
        for state, start in zip(question.model.states, question.starts, strict=True):
            if start is not None and start.free_symbols <= set(table):
                table[state.symbol] = Evaluation(algebra, table, 1)(start)
        before = Evaluation(algebra, dict(table), 1)
        for dose in question.doses:
            dosed = question.model.states[dose.state].symbol
            table[dosed] = table[dosed] + before(dose.fraction * dose.amount)
        evaluation = Evaluation(algebra, table, 1)
        found = [float(evaluation(e)[0, 0]) for e in expressions]
        half = len(found) // 2
        return np.asarray(np.array(found[:half]) - np.array(found[half:]))

    try:
        for _ in range(20):
            here = gap(point)
            if np.max(np.abs(here)) < 1e-13 * max(1.0, float(np.max(np.abs(point), initial=0.0))):
                variables = {**generic.variables, **dict(zip(names, map(float, point), strict=True))}
                return Base(variables, generic.constants, generic.widths, generic.question, True, generic.tempo)
            if not names:
                return None
            steps = 1e-7 * sizes
            slope = np.stack(
                [(gap(point + h * e) - here) / 1e-7 for h, e in zip(steps, np.eye(len(names)), strict=True)], axis=1
            )
            point = point - sizes * (np.linalg.pinv(slope) @ here)
    except (KeyError, np.linalg.LinAlgError):
        return None
    return None
