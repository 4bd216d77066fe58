"""Symmetries behind directions: scalings and translations of constants, functions, arguments and unmeasured states.

A direction of the constants shows that a change is unobservable; a symmetry gives a formula for it. Candidates are
generators with few weights: `k -> k (1 + a e)`, `f -> f (1 + b e)`, `x -> x (1 + w e)` (scaling), or additions in place
of factors (translation). Those that keep every residual of the jets zero form a null space, whose weights are small
fractions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from gbspec.arrays import Array
from gbspec.passes.identifiability.directions import Directions, at_order
from gbspec.passes.identifiability.generators import KINDS, Key, Kind, rational_null
from gbspec.passes.identifiability.jets import Base, Germ, LinearSystem
from gbspec.passes.identifiability.question import Question

CLEAR = 2
"""The order from which a shift of an argument is distinguished from an addition to the value."""

_OF_FUNCTIONS = ("value", "argument", "shift")


@dataclass(frozen=True)
class Symmetry:
    """A one-parameter transformation, by the weights of the quantities that it changes."""

    kind: Kind
    weights: Mapping[Key, Fraction]

    formals: Mapping[str, Sequence[str]]
    """Names of the arguments of each unknown."""

    @property
    def constants(self) -> list[str]:
        """The constants that it changes."""
        return [name for (what, name, _), weight in self.weights.items() if what == "constant" and weight]

    @property
    def states(self) -> list[str]:
        """The unmeasured states that it changes."""
        return [name for (what, name, _), weight in self.weights.items() if what == "state" and weight]

    @property
    def unknowns(self) -> list[str]:
        """The unknowns that it changes."""
        return list(dict.fromkeys(n for (what, n, _), w in self.weights.items() if what in _OF_FUNCTIONS and w))

    def __str__(self) -> str:
        weights = {key: weight for key, weight in self.weights.items() if weight}
        texts = [f"{key[1]} -> {self._moved(key[1], w)}" for key, w in weights.items() if key[0] == "constant"]
        texts += [f"{key[1]} -> {self._moved(key[1], w)}" for key, w in weights.items() if key[0] == "state"]
        texts += [f"{name} -> {self._function(name, weights)}" for name in self.unknowns]
        count = len(self.constants)
        return ", ".join([*reversed(texts[:count]), *texts[count:]])

    @property
    def _parameter(self) -> str:
        """The name of the transformation's parameter, which differs from all names of the model."""
        taken = {name for _, name, _ in self.weights} | {n for names in self.formals.values() for n in names}
        return next(name for name in ("c", "q", "w", "lambda", "c_") if name not in taken)

    def _moved(self, name: str, weight: Fraction) -> str:
        size, c = abs(weight), self._parameter
        if self.kind == "translation":
            return f"{name} {'+' if weight > 0 else '-'} {c if size == 1 else f'{size}*{c}'}"
        power = c if size == 1 else (f"{c}^{size}" if size.denominator == 1 else f"{c}^({size})")
        return f"{power}*{name}" if weight > 0 else f"{name}/{power}"

    def _function(self, name: str, weights: Mapping[Key, Fraction]) -> str:
        formals = self.formals[name]
        inside = "argument" if self.kind == "scaling" else "shift"
        moved = [
            self._moved(formal, -weights[inside, name, r]) if (inside, name, r) in weights else formal
            for r, formal in enumerate(formals)
        ]
        text = f"{name}({', '.join(moved)})" if moved != list(formals) else name
        if ("value", name, 0) in weights:
            text = self._moved(text, weights["value", name, 0])
        for r, formal in enumerate(formals):
            weight = weights.get(("argument", name, r), Fraction(0))
            if self.kind == "translation" and weight:
                size = "" if abs(weight) == 1 else f"{abs(weight)}*"
                text += f" {'+' if weight > 0 else '-'} {size}{self._parameter}*{formal}"
        return text


def symmetries(question: Question, directions: Directions) -> list[Symmetry]:
    """Scalings, then translations, that change some constant and keep all outputs."""
    return [found for found in transformations(question, directions) if found.constants]


def transformations(question: Question, directions: Directions) -> list[Symmetry]:
    """Scalings, then translations, that keep all outputs."""
    found: list[Symmetry] = []
    arguments = {u.name: question.model.networks[u.network].arguments for u in question.model.unknowns}
    formals = {name: [a.name for a in items] for name, items in arguments.items()}
    if directions.order < CLEAR:
        directions = at_order(question, CLEAR) or directions
    for kind in KINDS:
        keys = _keys(question, directions, kind)
        blocks = []
        for system, base in zip(directions.systems, directions.bases, strict=True):
            if base.beside:  # each of these trajectories has a base point of its own too
                continue
            generators = np.stack([_column(question, system, base, key, kind) for key in keys], axis=1)
            blocks.append(system.matrix @ generators)
        found += [Symmetry(kind, weights, formals) for weights in rational_null(np.concatenate(blocks), keys)]
    return found


def keeps_zeros(question: Question, found: Symmetry) -> bool:
    """Whether every function that a contract makes zero somewhere (`zero at v = e`) is still zero there."""
    for unknown in question.model.unknowns:
        formals = [argument.name for argument in question.model.networks[unknown.network].arguments]
        zeros = [(formals.index(c.argument or ""), c.value) for c in unknown.contracts if c.kind == "zero"]
        changes = {(what, r) for (what, name, r), weight in found.weights.items() if name == unknown.name and weight}
        if found.kind == "translation" and zeros and any(what in ("value", "argument") for what, _ in changes):
            return False
        if any((("argument", r) in changes and place != 0) or ("shift", r) in changes for r, place in zeros):
            return False
    return True


def _keys(question: Question, directions: Directions, kind: Kind) -> list[Key]:
    """The candidate weights, in order of preference; of states those that some expansion starts anywhere."""
    free = {name for system in directions.systems for name in system.starts}
    arguments: dict[str, int] = {a.unknown: len(a.arguments) for a in question.applications}
    keys: list[Key] = [("value", name, 0) for name in arguments]
    names = [question.model.states[i].name for i in question.hidden]
    keys += [("state", name, 0) for name in names if name in free]
    keys += [("argument", name, r) for name, count in arguments.items() for r in range(count)]
    if kind == "translation":
        keys += [("shift", name, r) for name, count in arguments.items() for r in range(count)]
    keys += [("constant", k.name, 0) for k in reversed(question.sought)]
    return keys


def _column(question: Question, system: LinearSystem, base: Base, key: Key, kind: Kind) -> Array:
    """The change caused by a unit of one weight, in the columns of a system."""
    what, name, position = key
    column = np.zeros(system.matrix.shape[1])
    if what == "constant":
        index = next(i for i, k in enumerate(question.sought) if k.name == name)
        column[index] = base.constants[question.sought[index].symbol] if kind == "scaling" else 1.0
    elif what == "state":
        _move_start(question, system, base, name, kind, column)
    else:
        for germ in system.germs:
            if germ.unknown == name:
                part = column[germ.column : germ.column + len(germ.exponents)]
                _move_germ(germ, what, position, kind, part)
    return column


def _move_start(question: Question, system: LinearSystem, base: Base, name: str, kind: Kind, column: Array) -> None:
    if name not in system.starts:  # as its expression says
        return
    symbol = next(s.symbol for s in question.model.states if s.name == name)
    first = system.starts[name]
    if kind == "translation":
        column[first] = 1.0
        return
    column[first] = base.variables[symbol]
    column[first + 1 + system.parameters.index(symbol)] = base.widths[symbol]


def _move_germ(germ: Germ, what: str, position: int, kind: Kind, part: Array) -> None:
    if what == "value":
        if kind == "scaling":
            part += germ.coefficients
        else:
            part[0] += 1.0
        return
    unit = tuple(int(r == position) for r in range(len(germ.base)))
    index = {exponent: k for k, exponent in enumerate(germ.exponents)}
    width = germ.widths[position]
    if what == "shift":
        for exponent, coefficient in zip(germ.exponents, germ.coefficients, strict=True):  # minus df/du
            if exponent[position]:
                lower = (*exponent[:position], exponent[position] - 1, *exponent[position + 1 :])
                part[index[lower]] -= exponent[position] * coefficient / width
        return
    if kind == "translation":  # c times the argument is added
        part[0] += germ.base[position]
        if unit in index:
            part[index[unit]] += width
        return
    for exponent, coefficient in zip(germ.exponents, germ.coefficients, strict=True):  # minus u df/du
        power = exponent[position]
        if power:
            part[index[exponent]] -= power * coefficient
            lower = (*exponent[:position], power - 1, *exponent[position + 1 :])
            part[index[lower]] -= power * coefficient * germ.base[position] / width
