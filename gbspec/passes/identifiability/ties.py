"""Points at which unknowns have equal arguments or known values: they tie what would else be independent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Expr
from gbspec.passes.identifiability.branches import Branches
from gbspec.passes.identifiability.jets import Base
from gbspec.passes.identifiability.question import Question
from gbspec.passes.identifiability.series import Algebra, Evaluation
from gbspec.passes.identifiability.starts import begin, follow, values_of

MOST_TIES = 6
"""The maximal number of points at which applications agree or vanish."""


def ties(question: Question, branches: Branches, generic: Base) -> Iterator[Base]:
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
    follow(question, values)
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


def agreed(question: Question, branches: Branches, base: Base, other: Base) -> Iterator[Base]:
    """The other base point, with states at which the arguments of unknowns are those of the first, where there are such
    states; and where an unknown has other arguments in its formulas, points at which these agree with the first's."""
    model = question.model
    held = {s.symbol for s in (*model.conditions, *model.inputs)} | {dose.amount for dose in question.doses}
    held |= {a.value for a in question.applications} | {model.time.symbol}
    states = {state.symbol for state in model.states}
    mine, others = _arguments(base), _arguments(other)
    formulas = other.question.applications

    def at(pairs: Sequence[tuple[int, int]]) -> Base | None:
        """The point where arguments of applications of the other are those of the first."""
        terms = [
            (e, here, now)
            for i, j in pairs
            for e, here, now in zip(formulas[j].arguments, mine[i], others[j], strict=True)
            if e.free_symbols & states
        ]
        if all(np.isclose(here, now, rtol=1e-9, atol=1e-12) for _, here, now in terms):
            return other
        wanted = [sympy.Float(here) for _, here, _ in terms]
        moved = _agreeing(other.question, [e for e, _, _ in terms], wanted, other, frozenset(held))
        return None if moved is None else _with_branches(question, branches, moved)

    here, there = (_used(each.question) for each in (base, other))
    yield at([(i, i) for i in sorted(here & there)]) or other
    crossed = [
        (i, j)
        for i in sorted(here)
        for j in sorted(there)
        if i != j and formulas[i].unknown == formulas[j].unknown and not {i, j} <= here & there
    ]
    for pair in crossed[:MOST_TIES]:
        moved = at([pair])
        if moved is not None:
            yield moved


def _used(question: Question) -> set[int]:
    """The numbers of the applications that rates and outputs depend on."""
    symbols = {symbol for e in (*question.rates, *question.outputs) for symbol in e.free_symbols}
    found: set[int] = set()
    for k, application in reversed(list(enumerate(question.applications))):  # outer ones are behind inner ones
        if application.value in symbols:
            found.add(k)
            symbols.update(symbol for argument in application.arguments for symbol in argument.free_symbols)
    return found


def _arguments(base: Base) -> list[list[float]]:
    """The values of the arguments of each application at a base point."""
    values = {symbol: np.full(1, value) for symbol, value in (*base.constants.items(), *base.variables.items())}
    values.update((a.value, np.ones(1)) for a in base.question.applications)
    begin(base.question, values)
    return [[float(values_of(e, values)[0]) for e in a.arguments] for a in base.question.applications]
