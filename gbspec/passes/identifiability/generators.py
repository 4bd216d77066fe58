"""Generators of exact symmetries: scalings and translations under which the equations themselves do not change.

A generator X = sum of w_j x_j d/dx_j (scaling) or w_j d/dx_j (translation), over the sought constants, the unmeasured
states and, for scalings, the values of unknown functions, leaves all outputs of all solutions as they are if X(rate) =
w rate, X(start) = w start and X(dose) = w dose for each state (without the factor for translations), and if X of each
output, lag and argument of an unknown is zero. These conditions are linear in the weights and hold everywhere if they
hold at random points. Unlike directions of truncated expansions, which more orders may still exclude, such a direction
stays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Literal

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Expr, derivative
from gbspec.passes.identifiability.branches import Branches, evaluated
from gbspec.passes.identifiability.points import bases_of
from gbspec.passes.identifiability.question import Question

Kind = Literal["scaling", "translation"]
KINDS: tuple[Kind, ...] = ("scaling", "translation")
Key = tuple[str, str, int]
"""The subject of a weight: ("constant", name, 0), ("state", name, 0), or for an unknown ("value", name, 0), its
argument scaled or added to the value ("argument", name, r), its argument shifted ("shift", name, r).
"""

Weights = Mapping[Key, Fraction]

ROUNDS = 6
"""So often points are drawn, at least one for each branch of the equations."""

MOST_WEIGHTS = 80


def exact(question: Question, kind: Kind) -> list[dict[Key, Fraction]]:
    """A basis of the exact scalings or translations; empty where they are too many to look for, or have no value."""
    keys = _keys(question, kind)
    if not keys or len(keys) > MOST_WEIGHTS:
        return []
    free = replace(question, starts=(None,) * len(question.starts))
    branches = Branches(free)
    rng = np.random.default_rng(len(keys))
    rows: list[Array] = []
    for _ in range(ROUNDS):
        for base in bases_of(free, branches, rng):
            if base.certain and not base.beside:  # trajectories beside others have base points of their own too
                values = {**base.variables, **base.constants}
                values |= {a.value: float(rng.uniform(0.3, 2.0)) for a in question.applications}
                rows += list(_conditions(question, base.question, keys, kind, values))
    matrix = np.stack(rows)
    matrix = matrix[np.all(np.isfinite(matrix), axis=1)]
    return rational_null(matrix, list(keys)) if len(matrix) >= len(keys) else []


def moved(question: Question, constants: Mapping[sympy.Symbol, float]) -> Array:
    """The changes of the sought constants, at their values, by all exact generators, one a row."""
    rows = []
    for kind in KINDS:
        sizes = [constants[k.symbol] if kind == "scaling" else 1.0 for k in question.sought]
        for weights in exact(question, kind):
            moves = [float(weights["constant", k.name, 0]) for k in question.sought]
            rows.append(np.array(moves) * np.array(sizes))
    return np.array(rows).reshape(len(rows), len(question.sought))


def _keys(question: Question, kind: Kind) -> dict[Key, tuple[sympy.Symbol, ...]]:
    """The candidate weights, in order of preference, with the symbols that each moves."""
    keys: dict[Key, tuple[sympy.Symbol, ...]] = {}
    for a in question.applications if kind == "scaling" else ():
        keys["value", a.unknown, 0] = tuple(b.value for b in question.applications if b.unknown == a.unknown)
    states = question.model.states
    keys.update({("state", states[i].name, 0): (states[i].symbol,) for i in question.hidden})
    keys.update({("constant", k.name, 0): (k.symbol,) for k in reversed(question.sought)})
    return keys


def _conditions(
    question: Question,
    here: Question,
    keys: Mapping[Key, tuple[sympy.Symbol, ...]],
    kind: Kind,
    values: Mapping[sympy.Symbol, float],
) -> Iterator[Array]:
    """The linear conditions on the weights at one point, each divided by its largest term."""
    at = evaluated({symbol: np.array([value]) for symbol, value in values.items()}, 1)
    index = {key: k for k, key in enumerate(keys)}
    names = [("state", state.name, 0) for state in question.model.states]

    def row(e: Expr, own: Key | None = None, weight: Expr | None = None) -> Array:
        terms = np.zeros(len(keys))
        for key, symbols in keys.items():
            for symbol in symbols:
                if symbol in e.free_symbols:
                    slope = float(at(derivative(e, symbol)).flat[0])
                    terms[index[key]] += slope * (values[symbol] if kind == "scaling" else 1.0)
        if own in index and weight is not None:
            terms[index[own]] -= float(at(weight).flat[0])
        largest = float(np.max(np.abs(terms), initial=0.0))
        return terms / largest if largest > 0 else terms

    with np.errstate(all="ignore"):  # rows without a value are left out
        for i, rate in enumerate(here.rates):
            yield row(rate, names[i], rate if kind == "scaling" else None)
        for i, start in enumerate(question.starts):
            if start is not None:
                yield row(start, names[i], start if kind == "scaling" else sympy.S.One)
        for dose in question.doses:
            yield row(dose.fraction, names[dose.state], dose.fraction if kind == "scaling" else None)
            yield row(dose.lag)
        for e in (*here.outputs, *(argument for a in here.applications for argument in a.arguments)):
            yield row(e)


# ------------------------------------------------------------------------------------------------------ linear algebra


def rational_null(matrix: Array, keys: Sequence[Key]) -> list[dict[Key, Fraction]]:
    """A basis of the null space with small fractions as entries; vectors without such entries are left out."""
    norms = np.linalg.norm(matrix, axis=0)
    scaled = matrix / np.where(norms > 0, norms, 1.0)
    _, values, right = np.linalg.svd(scaled, full_matrices=True)
    rank = int(np.sum(values > 1e-9 * max(values[0], 1e-300))) if values.size else 0
    null = right[rank:] / np.where(norms > 0, norms, 1.0)
    found = []
    for vector in echelon(null[:, ::-1])[:, ::-1]:
        weights = {key: Fraction(float(v)).limit_denominator(12) for key, v in zip(keys, vector, strict=True)}
        near = max(abs(float(weights[key]) - v) for key, v in zip(keys, vector, strict=True)) < 1e-5
        if near and _solves(matrix, np.array([float(weights[key]) for key in keys])):
            found.append(weights)
    return found


def _solves(matrix: Array, weights: Array) -> bool:
    """Whether weights solve every equation: beside its own terms, as these may be small beside those of others."""
    terms = matrix * weights
    largest = np.max(np.abs(matrix), axis=1, initial=0.0) * np.max(np.abs(weights), initial=0.0)
    return bool(np.all(np.abs(terms.sum(axis=1)) <= 1e-7 * np.abs(terms).sum(axis=1) + 1e-12 * largest))


def echelon(rows: Array) -> Array:
    """Reduced row echelon form, with pivots in the first columns that allow it."""
    rows = rows.copy()
    top = 0
    for column in range(rows.shape[1]):
        if top == len(rows):
            break
        best = top + int(np.argmax(np.abs(rows[top:, column])))
        if abs(rows[best, column]) < 1e-7 * max(1.0, float(np.max(np.abs(rows)))):
            continue
        rows[[top, best]] = rows[[best, top]]
        rows[top] /= rows[top, column]
        for other in range(len(rows)):
            if other != top:
                rows[other] -= rows[other, column] * rows[top]
        top += 1
    return rows[:top]
