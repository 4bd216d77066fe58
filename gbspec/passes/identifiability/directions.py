"""Changes of constants that unknown functions and initial values can compensate: null spaces of the jets' systems."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import comb

import numpy as np
import sympy

from gbspec.arrays import Array, Mask
from gbspec.passes.identifiability.branches import Branches
from gbspec.passes.identifiability.generators import moved
from gbspec.passes.identifiability.jets import Base, LinearSystem, size, system_at
from gbspec.passes.identifiability.points import bases_of
from gbspec.passes.identifiability.precise import Precise, examinable, null_at
from gbspec.passes.identifiability.question import Question
from gbspec.passes.identifiability.reach import Reach
from gbspec.passes.identifiability.series import Algebra, Effort, OutOfEffortError
from gbspec.passes.identifiability.undecided import Open, Why

SMALL = 1e-8
"""Singular values below this fraction of the largest count as zero."""

MOST_COLUMNS = 1200
ORDERS = range(1, 6)
MOST_ORDERS = 15
"""The highest order, where constants are far from what is observed or low orders tell nothing."""
SILENT = 5
"""After more orders than these that tell nothing, more effort is not what is missing."""
PROBED = 1e-6
"""A made-up term of which a smaller fraction is left counts as compensated."""
DECOMPOSITION = 0.5
"""What the decompositions of a system cost, in multiplications, by its rows, columns and the smaller of both."""
EARLY = 0.25
"""The part of the effort left that numbers of many digits may take at the first order at which the answer settles."""
LINES = 160
SEED = 20


@dataclass(frozen=True)
class Directions:
    """The directions in which parameters cannot be identified.

    `basis` has as columns the changes of the sought constants without an observable effect; `systems` the expansions
    they were found with; `functions` the names of unknowns that can change unobserved with all constants known.
    `own` are the constants of single trajectories that can change unobserved, with those functions or with each other.
    `doubtful` has further directions: nothing that data surely reach excludes them, but something that they may reach
    does, as a branch beyond what a known start shows.
    """

    basis: Array
    systems: tuple[LinearSystem, ...]
    bases: tuple[Base, ...]
    functions: tuple[str, ...]
    order: int
    doubtful: Array = field(default_factory=lambda: np.zeros((0, 0)))
    own: tuple[str, ...] = ()
    faint: tuple[str, ...] = ()
    """The constants whose effects are too small beside others to be told from rounding."""
    tells: bool = True
    """Whether the expansions are long enough: else they say nothing of any constant."""

    @property
    def sizes(self) -> Array:
        """The sizes of the sought constants, beside which a change of them is large or none."""
        constants = self.bases[0].constants
        return sizes_of(self.bases[0].question, constants)


def sizes_of(question: Question, constants: Mapping[sympy.Symbol, float]) -> Array:
    """The sizes of the sought constants at a point: their values, or 1."""
    return np.array([abs(constants[k.symbol]) or 1.0 for k in question.sought])


def find(question: Question, effort: Effort) -> Directions | Open:
    """The directions at increasing order, until their number is constant; what ended the search if it is before that.

    Equal ranks in a row end the search, of orders above that at which the last constant can show, and at which the
    expansions tell something: at low orders free initial values of unmeasured states compensate everything. Two are
    enough where made-up terms show that, three with unmeasured states where an unknown function of everything is in
    each rate: each unmeasured state may need one more derivative before it affects an output. From known starts, at
    which rates may cancel as in a steady state, each state may need one more too. Directions that exact symmetries
    explain are decided before, and where orders or effort end first: no further order excludes them. Others may be
    rounding: numbers of many digits decide, at a low order where they leave nothing, else at the last.
    """
    reach = Reach(question).orders()
    first = int(np.max(reach[np.isfinite(reach)], initial=0.0))
    cancelling = len(question.starts) if any(start is not None for start in question.starts) else 0
    last = max(ORDERS[-1], min(first + cancelling + 1, MOST_ORDERS))
    needed = 3 if question.hidden and not question.probed else 2
    past: list[Directions] = []
    branches = Branches(question)
    silent, ended, early = 0, None, True
    for order in range(1, MOST_ORDERS + 1):
        if order > last + silent:
            break
        large = size(question, order) > MOST_COLUMNS
        found = None if large else at_order(question, order, effort, branches)
        if found is None:
            ended = Open(_ended(large, effort, silent if not past else 0), order - 1)
            break
        if not found.basis.shape[1] and not found.functions and not found.own and not found.doubtful.shape[1]:
            return found
        if not found.tells:
            silent += 1
            continue
        past.append(found)
        ranks = {(e.basis.shape[1], e.doubtful.shape[1], e.functions, e.own) for e in past[-needed:]}
        settled = order > first and len(past) >= needed and len(ranks) == 1
        if settled and _explained(question, found):
            return found
        if settled and early:
            early, apart = False, _all_apart(question, found, effort)
            if apart is not None:
                return apart
        if settled and order > first + cancelling:
            return _precisely(question, found, (found.order, last), effort) or found
    if past and _explained(question, past[-1]):
        return past[-1]
    if past and ended is None:
        more = _precisely(question, past[-1], (first + cancelling + 1, last), effort)
        if isinstance(more, Directions):
            return more
    return ended or Open(Why.ORDERS if past else Why.COMPENSATED, min(last + silent, MOST_ORDERS))


def _by_digits(question: Question, found: Directions) -> bool:
    """Whether numbers of many digits decide a question."""
    return not found.functions and not found.own and examinable(question)


def _all_apart(question: Question, found: Directions, effort: Effort) -> Directions | None:
    """No directions, if numbers of many digits leave none at the order of what was `found`: higher orders only exclude
    more. They may take a part of the effort."""
    if not _by_digits(question, found):
        return None
    share = Effort(max(effort.left, 0.0) * EARLY)
    given = share.left
    basis = _precise_basis(question, found.order, share)
    if math.isfinite(given):
        effort.left -= given - max(share.left, 0.0)
    return _instead(found, basis, found.order) if basis is not None and not basis.shape[1] else None


def _precisely(
    question: Question, found: Directions, orders: tuple[int, int], effort: Effort
) -> Directions | Open | None:
    """The directions that numbers of many digits leave, at two orders in a row or as many as were `found`: what
    excludes a direction may be smaller than rounding beside the rest. Open where they do not come to an answer, so that
    what was found may be rounding; None for questions that they do not decide."""
    if not _by_digits(question, found):
        return None
    count = found.basis.shape[1] + found.doubtful.shape[1] if orders[0] == found.order else None
    last = max(orders[1], orders[0] + 2)
    for order in range(orders[0], last + 1):
        basis = _precise_basis(question, order, effort)
        if basis is None:
            return Open(Why.ROUNDING, order)
        if basis.shape[1] in (0, count):
            return _instead(found, basis, order)
        count = basis.shape[1]
    return Open(Why.ORDERS, last)


def _instead(found: Directions, basis: Array, order: int) -> Directions:
    """What was found, with the directions that numbers of many digits leave."""
    return replace(found, basis=basis, doubtful=np.zeros((len(basis), 0)), faint=(), order=order)


def _precise_basis(question: Question, order: int, effort: Effort) -> Array | None:
    """The directions of one order with many digits, in the constants' own units; None where they were not found."""
    model, rng = question.model, np.random.default_rng(SEED + order)
    base = next(bases_of(question, Branches(question), rng), None)
    moving = None in question.starts or model.conditions or model.inputs or model.doses or model.time.start is None
    varied = bool(moving)
    algebra, lines = Precise(order, order, effort, varied), _lines(question, order) if varied else 1  # all are the same
    basis = None if base is None else null_at(base, algebra, lines, rng)
    if base is None or basis is None:
        return None
    return _unscaled(basis, sizes_of(question, base.constants))


def _ended(large: bool, effort: Effort, silent: int) -> Why:
    """What ended the search: after so many orders that told nothing, not their size or effort."""
    if not large and effort.left >= 0:
        return Why.VALUES
    return Why.COMPENSATED if silent > SILENT else Why.SIZE if large else Why.EFFORT


def _explained(question: Question, found: Directions) -> bool:
    """Whether exact symmetries span the directions."""
    if found.functions or found.own or found.doubtful.shape[1]:
        return False
    constants = found.bases[0].constants
    sizes = sizes_of(question, constants)
    proved = moved(question, constants) / sizes
    count = found.basis.shape[1]
    both = np.concatenate([proved, (found.basis / sizes[:, None]).T])
    norms = np.maximum(np.linalg.norm(both, axis=1), 1e-300)[:, None]
    ranks = {int(np.linalg.matrix_rank(part, tol=1e-6)) for part in ((both / norms)[: len(proved)], both / norms)}
    return bool(len(proved)) and ranks == {count}


def at_order(
    question: Question, order: int, effort: Effort | None = None, branches: Branches | None = None
) -> Directions | None:
    """The directions that remain at one order; None if an expression has no value or the effort is spent."""
    moving = question.hidden or question.own or question.alone
    still = not moving and all(start is None for start in question.starts)
    algebra = Algebra(order, 0 if still else order, effort or Effort())
    rng = np.random.default_rng(SEED + order)
    bases: list[Base] = []
    systems: list[LinearSystem] = []
    equations: list[Array] = []
    lines, count = _lines(question, order), len(question.sought)
    for base in bases_of(question, branches or Branches(question), rng):
        scales = sizes_of(question, base.constants)
        try:
            with np.errstate(all="ignore"):
                system = system_at(base, algebra, lines, rng)
            rows, columns = system.matrix.shape
            algebra.effort.spend(DECOMPOSITION * rows * columns * min(rows, columns))
        except OutOfEffortError:
            return None
        if np.all(np.isfinite(system.matrix)):
            bases.append(base)
            systems.append(_scaled(system))
            equations.append(_reduced(system, scales))
            if not _common_null(equations, count).shape[1] and (question.hidden or not any(_loose(systems))):
                break  # more points can only exclude more
        elif base.certain:
            return None
    if not systems:
        return None
    certain = [each for each, system in zip(equations, systems, strict=True) if system.certain]
    faint = _faint(systems, scales)
    unsure = [_thresholds(question), np.diag(faint.astype(float))]
    sure, basis = _common_null(certain, count), _common_null([*equations, *unsure], count)
    functions, own = _loose(systems) if not question.hidden else ((), ())
    doubtful = _unscaled(_common_null([np.asarray(basis.T), _equations_of(sure)], count), scales)
    tells = _tells(systems)
    natural = _unscaled(basis, scales)
    unclear = tuple(k.name for k, small in zip(question.sought, faint, strict=True) if small)
    return Directions(natural, tuple(systems), tuple(bases), functions, order, doubtful, own, unclear, tells)


def _equations_of(basis: Array) -> Array:
    """Equations whose null space is spanned by orthonormal columns."""
    return np.asarray(np.eye(len(basis)) - basis @ basis.T)


def _thresholds(question: Question) -> Array:
    """Doubt about constants in conditions, and in what jumps: data may show where a branch changes, which its formulas
    do not."""
    names: set[sympy.Basic] = set()
    for expression in (*question.rates, *question.outputs):
        for atom in expression.atoms(sympy.Piecewise):
            names.update(*(condition.free_symbols for _, condition in atom.args))
        names.update(*(atom.free_symbols for atom in expression.atoms(sympy.sign, sympy.floor)))
    return np.diag([1.0 if k.symbol in names else 0.0 for k in question.sought])


def _faint(systems: Sequence[LinearSystem], scales: Array) -> Mask:
    """The constants whose effects are not zero, and too small beside others to be told from rounding: with
    rates that differ by many decades the expansion is no measure of what data at other times tell."""
    largest = np.zeros(len(scales))
    for system in systems:
        sizes = np.abs(system.matrix)
        sizes[:, : system.constants] *= scales
        share = sizes[:, : system.constants] / np.maximum(sizes.max(axis=1, initial=0.0), 1e-300)[:, None]
        largest = np.maximum(largest, share.max(axis=0, initial=0.0))
    return np.asarray((largest > 0) & (largest < SMALL))


def _lines(question: Question, order: int) -> int:
    model = question.model
    space = len(model.states) + len(model.conditions) + len(question.signals) + len(model.inputs)
    equations = max(1, len(question.known) + len(question.outputs)) * (order + 1)
    return min(LINES, comb(order + space, order) + 4, 8 + 2 * size(question, order) // equations)


# ------------------------------------------------------------------------------------------------------ linear algebra


def _unscaled(basis: Array, scales: Array) -> Array:
    """The directions in the constants' own units, each of length 1."""
    natural = basis * scales[:, None]
    norms = np.linalg.norm(natural, axis=0)
    return np.asarray(natural / np.where(norms > 0, norms, 1.0))


def _scaled(system: LinearSystem) -> LinearSystem:
    """Rows scaled to equal norm, so that high orders do not dominate low ones; zero rows removed.

    The norm is that of effects of changes of natural size: else a constant of 1e-8 hid all others of its rows.
    """
    norms = np.max(np.abs(system.matrix) * system.sizes, axis=1, initial=0.0)
    kept = norms > 1e-13
    system.matrix = system.matrix[kept] / norms[kept, None]
    system.probes = system.probes[kept] / norms[kept, None]
    return system


def _tells(systems: Sequence[LinearSystem]) -> bool:
    """Whether an expansion is long enough to tell anything: at low order free initial values and functions compensate
    everything, also made-up terms of the rates, so that it says nothing of constants that they compensate too."""
    count = systems[0].probes.shape[1]
    seen, acts = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for system in systems:
        sizes = np.linalg.norm(system.probes, axis=0)
        left = np.linalg.norm(_without_others(system, system.probes), axis=0)
        acting = sizes >= 1e-12
        seen |= acting & (left > PROBED * sizes)
        acts |= acting  # a branch that shows nothing, as of a sensor at its limit, does not speak for the others
    return bool((seen | ~acts).all())


def _compressed(matrix: Array) -> Array:
    """A matrix with the same null space and no more rows than columns."""
    return np.asarray(np.linalg.qr(matrix, mode="r")) if matrix.shape[0] > matrix.shape[1] else matrix


def _reduced(system: LinearSystem, scales: Array) -> Array:
    """The equations in the constants only, in units of `scales`, with functions and initial values eliminated."""
    return _without_others(system, system.matrix[:, : system.constants] * scales)


def _without_others(system: LinearSystem, columns: Array) -> Array:
    """Columns of residuals without what functions and initial values can compensate."""
    whole = _compressed(np.concatenate([columns, system.matrix[:, system.constants :]], axis=1))
    kept, others = whole[:, : columns.shape[1]], whole[:, columns.shape[1] :]
    if not others.shape[1] or not whole.shape[0]:
        return kept
    norms = np.linalg.norm(others, axis=0)
    others = others[:, norms > 0] / norms[norms > 0]
    if not others.shape[1]:
        return kept
    left, values, _ = np.linalg.svd(others, full_matrices=False)
    span = left[:, values > SMALL * values[0]]
    return np.asarray(kept - span @ (span.T @ kept))


def _common_null(equations: Sequence[Array], count: int) -> Array:
    """The common null space, as columns."""
    if not count or not equations:
        return np.eye(count)
    stacked = np.concatenate(equations)
    if not stacked.size or np.max(np.abs(stacked)) < SMALL:
        return np.eye(count)
    _, values, right = np.linalg.svd(stacked, full_matrices=True)
    rank = int(np.sum(values > 1e-7))
    return np.asarray(right[rank:].T)


def _loose(systems: Sequence[LinearSystem]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Unknowns whose value can change with shared constants, initial values and outputs fixed, and constants of single
    trajectories that can: those that can at every point."""
    functions, own = set[str](), set[str]()
    for k, system in enumerate(systems):
        others = _compressed(system.matrix[:, system.constants :])
        if not others.shape[1]:
            return (), ()
        _, values, right = np.linalg.svd(others, full_matrices=True)
        rank = int(np.sum(values > SMALL * values[0])) if values.size else 0
        moves = np.max(np.abs(right[rank:]), axis=0, initial=0.0) > 1e-5
        unknowns = {germ.unknown for germ in system.germs if moves[germ.column - system.constants]}
        single = {name for name, columns in system.own.items() if all(moves[c - system.constants] for c in columns)}
        functions, own = (functions & unknowns, own & single) if k else (unknowns, single)
    return tuple(sorted(functions)), tuple(sorted(own))


def absorbers(directions: Directions, direction: Array) -> set[str]:
    """The unknowns, and constants of each trajectory, that must change along a direction of the constants."""
    names: set[str] = set()
    least = 1e-4 * np.max(np.abs(direction / directions.sizes))
    for system in _telling(directions):
        constants, others = system.matrix[:, : system.constants], system.matrix[:, system.constants :]
        if not others.shape[1]:
            continue
        answer = np.linalg.lstsq(others, -constants @ direction, rcond=1e-10)[0]
        for germ in system.germs:
            first = germ.column - system.constants
            if np.max(np.abs(answer[first : first + 1 + len(germ.base)])) > least:
                names.add(germ.unknown)
        for name, columns in system.own.items():
            if max(abs(answer[c - system.constants]) / system.sizes[c] for c in columns) > least:
                names.add(name)
    return names


def _telling(directions: Directions) -> list[LinearSystem]:
    """The systems of all formulas, without those of single points whose formulas one of several trajectories has."""
    several = [base for base in directions.bases if base.beside and base.certain]
    told = {each.question.rates for base in several for each in (base, *base.beside)}
    pairs = zip(directions.bases, directions.systems, strict=True)
    return [system for base, system in pairs if base.beside or base.question.rates not in told]
