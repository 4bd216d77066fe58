"""Changes of constants that unknown functions and initial values can compensate: null spaces of the jets' systems."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Expr
from gbspec.passes.identifiability.jets import Base, Jet, LinearSystem, OutOfTime, size
from gbspec.passes.identifiability.question import Question
from gbspec.passes.identifiability.series import Algebra, Evaluation

SMALL = 1e-8
"""Singular values below this fraction of the largest count as zero."""

MOST_COLUMNS = 1200
ORDERS = range(1, 6)
LINES = 160
SEED = 20


@dataclass(frozen=True)
class Directions:
    """The directions in which parameters cannot be identified.

    `basis` has as columns the changes of the sought constants without an observable effect; `systems` the expansions
    they were found with; `functions` the names of unknowns that can change unobserved with all constants known.
    """

    basis: Array
    systems: tuple[LinearSystem, ...]
    bases: tuple[Base, ...]
    functions: tuple[str, ...]
    order: int


def find(question: Question, deadline: float) -> Directions | None:
    """The directions at increasing order, until their number is constant; None (undecided) if the budget ends first.

    With every state measured two equal ranks in a row end the search, with unmeasured ones three: each unmeasured state
    may need one more derivative before it affects an output.
    """
    needed = 3 if question.hidden else 2
    ranks: list[tuple[int, tuple[str, ...]]] = []
    for order in ORDERS:
        if size(question, order) > MOST_COLUMNS or time.process_time() > deadline:
            break
        found = at_order(question, order, deadline)
        if found is None:
            break
        if not found.basis.shape[1] and not found.functions:
            return found
        ranks.append((found.basis.shape[1], found.functions))
        if len(ranks) >= needed and len(set(ranks[-needed:])) == 1:
            return found
    return None


def at_order(question: Question, order: int, deadline: float = math.inf) -> Directions | None:
    """The directions that remain at one order; None if an expression has no value or time runs out."""
    instantaneous = not question.hidden and all(start is None for start in question.starts)
    algebra = Algebra(order, 0 if instantaneous else order)
    rng = np.random.default_rng(SEED + order)
    bases = _bases(question, rng)
    systems: list[LinearSystem] = []
    columns = size(question, order)
    space = len(question.model.states) + len(question.model.conditions) + len(question.model.inputs)
    equations = max(1, len(question.known) + len(question.outputs)) * (order + 1)
    lines = min(LINES, comb(order + space, order) + 4, 8 + 2 * columns // equations)
    for base in bases:
        try:
            with np.errstate(all="ignore"):
                system = Jet(question, base, algebra, lines, rng, deadline).system()
        except OutOfTime:
            return None
        if not np.all(np.isfinite(system.matrix)) or time.process_time() > deadline:
            return None
        systems.append(_scaled(system))
    basis = _common_null([_reduced(system) for system in systems], len(question.sought))
    functions = _free_functions(systems) if not question.hidden else ()
    return Directions(basis, tuple(systems), tuple(bases), functions, order)


# ----------------------------------------------------------------------------------------------------- base points


def _bases(question: Question, rng: np.random.Generator) -> list[Base]:
    """A generic point, points at zeros of unknowns, and points at which two applications have equal arguments."""
    bases = [_generic(question, rng)]
    for application in question.applications:
        for r, place in application.zeros:
            base = _agreeing(question, [application.arguments[r]], [place], rng)
            if base is not None:
                bases.append(base)
    for i, first in enumerate(question.applications):
        for second in question.applications[:i]:
            if first.unknown == second.unknown and len(bases) < 6:
                base = _agreeing(question, first.arguments, second.arguments, rng)
                if base is not None:
                    bases.append(base)
    return bases


def _generic(question: Question, rng: np.random.Generator) -> Base:
    model = question.model
    symbols = [s.symbol for s, start in zip(model.states, question.starts, strict=True) if start is None]
    symbols += [*(c.symbol for c in model.conditions), *(i.symbol for i in model.inputs)]
    if model.time.start is None:
        symbols.append(model.time.symbol)
    variables = {s: float(v) for s, v in zip(symbols, rng.uniform(0.5, 1.5, size=len(symbols)), strict=True)}
    constants = {c.symbol: c.value for c in model.constants}
    for learnable in model.learnables:
        low, high = learnable.range.low, learnable.range.high
        value = float(rng.uniform(0.6, 1.4)) * (learnable.start or 0.7)
        constants[learnable.symbol] = value if low < value < high else learnable.start
    return Base(variables, constants)


def _agreeing(
    question: Question, first: Sequence[Expr], second: Sequence[Expr], rng: np.random.Generator
) -> Base | None:
    """A point where expressions have the same values, by Newton's method with minimum-norm steps."""
    values = {a.value for a in question.applications}
    expressions = [*first, *second]
    if any(e.free_symbols & values for e in expressions):
        return None
    base = _generic(question, rng)
    names = list(base.variables)
    point = np.array([base.variables[n] for n in names])
    algebra = Algebra(0, 0)

    def gap(at: Array) -> Array:
        table = {n: algebra.constant(np.array([v])) for n, v in (*zip(names, at, strict=True), *base.constants.items())}
        for state, start in zip(question.model.states, question.starts, strict=True):
            if start is not None and start.free_symbols <= set(table):
                table[state.symbol] = Evaluation(algebra, table, 1)(start)
        evaluation = Evaluation(algebra, table, 1)
        found = [float(evaluation(e)[0, 0]) for e in expressions]
        half = len(found) // 2
        return np.asarray(np.array(found[:half]) - np.array(found[half:]))

    try:
        for _ in range(20):
            here = gap(point)
            if np.max(np.abs(here)) < 1e-13:
                return Base(dict(zip(names, map(float, point), strict=True)), base.constants)
            slope = np.stack([(gap(point + 1e-7 * e) - here) / 1e-7 for e in np.eye(len(names))], axis=1)
            point = point - np.linalg.pinv(slope) @ here
    except (KeyError, np.linalg.LinAlgError):
        return None
    return None


# ------------------------------------------------------------------------------------------------------ linear algebra


def _scaled(system: LinearSystem) -> LinearSystem:
    """Rows scaled to equal norm, so that high orders do not dominate low ones; zero rows removed."""
    norms = np.max(np.abs(system.matrix), axis=1, initial=0.0)
    kept = norms > 1e-13
    system.matrix = system.matrix[kept] / norms[kept, None]
    return system


def _compressed(matrix: Array) -> Array:
    """A matrix with the same null space and no more rows than columns."""
    return np.asarray(np.linalg.qr(matrix, mode="r")) if matrix.shape[0] > matrix.shape[1] else matrix


def _reduced(system: LinearSystem) -> Array:
    """The equations in the constants only, with functions and initial values eliminated."""
    matrix = _compressed(system.matrix)
    constants, others = matrix[:, : system.constants], matrix[:, system.constants :]
    if not others.shape[1] or not matrix.shape[0]:
        return constants
    norms = np.linalg.norm(others, axis=0)
    others = others[:, norms > 0] / norms[norms > 0]
    if not others.shape[1]:
        return constants
    left, values, _ = np.linalg.svd(others, full_matrices=False)
    span = left[:, values > SMALL * values[0]]
    return constants - span @ (span.T @ constants)


def _common_null(equations: Sequence[Array], count: int) -> Array:
    """The common null space, as columns."""
    if not count:
        return np.zeros((0, 0))
    stacked = np.concatenate(equations)
    if not stacked.size or np.max(np.abs(stacked)) < SMALL:
        return np.eye(count)
    _, values, right = np.linalg.svd(stacked, full_matrices=True)
    rank = int(np.sum(values > 1e-7))
    return np.asarray(right[rank:].T)


def _free_functions(systems: Sequence[LinearSystem]) -> tuple[str, ...]:
    """Unknowns whose value can change with constants, initial values and outputs fixed."""
    moving: set[str] | None = None
    for system in systems:
        others = _compressed(system.matrix[:, system.constants :])
        if not others.shape[1]:
            return ()
        _, values, right = np.linalg.svd(others, full_matrices=True)
        rank = int(np.sum(values > SMALL * values[0])) if values.size else 0
        null = right[rank:]
        names = {
            germ.unknown
            for germ in system.germs
            if null.size and np.max(np.abs(null[:, germ.column - system.constants])) > 1e-5
        }
        moving = names if moving is None else moving & names
    return tuple(sorted(moving or ()))


def absorbers(directions: Directions, direction: Array) -> set[str]:
    """The unknowns, and constants of each trajectory, that must change along a direction of the constants."""
    names: set[str] = set()
    for system in directions.systems:
        constants, others = system.matrix[:, : system.constants], system.matrix[:, system.constants :]
        if not others.shape[1]:
            continue
        answer = np.linalg.lstsq(others, -constants @ direction, rcond=1e-10)[0]
        for germ in system.germs:
            first = germ.column - system.constants
            if np.max(np.abs(answer[first : first + 1 + len(germ.base)])) > 1e-4 * np.max(np.abs(direction)):
                names.add(germ.unknown)
        for name, column in system.own.items():
            if abs(answer[column - system.constants]) > 1e-4 * np.max(np.abs(direction)):
                names.add(name)
    return names
