"""The linear system for directions: small changes of constants, functions and initial values that keep all outputs.

Around a base point, trajectories are expanded along lines through the space of initial values, conditions and inputs,
as power series in time and along the line. An unknown function has a random Taylor polynomial at each argument at which
it is applied (a germ), and its change another one with free coefficients. An initial value or constant that is free for
each trajectory changes by a polynomial in the quantities that distinguish trajectories. A direction is a vector of a
change of the constants and of all these coefficients; it keeps all outputs if every coefficient of every residual is
zero. The true directions are always among those found; with increasing order the others disappear.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb

import numpy as np
import sympy

from gbspec.arrays import Array, Mask
from gbspec.ir import Expr, derivative
from gbspec.passes.identifiability.question import Application, Question
from gbspec.passes.identifiability.series import Algebra, Evaluation

CHANGE = 20_000
"""What the derivatives of an expression cost, in multiplications."""


def monomials(variables: int, order: int) -> list[tuple[int, ...]]:
    """Exponents of all monomials up to an order, each after those that it is a multiple of."""
    found = []
    for degree in range(order + 1):
        for choice in combinations_with_replacement(range(variables), degree):
            found.append(tuple(choice.count(r) for r in range(variables)))
    return found


@dataclass
class Germ:
    """An unknown near one point of its arguments: random coefficients, and its first column in the system."""

    unknown: str
    base: tuple[float, ...]
    widths: tuple[float, ...]
    """Its monomials are in the arguments minus their base values, divided by these."""
    exponents: list[tuple[int, ...]]
    coefficients: Array
    column: int
    free: Mask
    """The coefficients that are free: not those that a contract makes 0."""


@dataclass
class Base:
    """A base point: values of the variables at which everything is expanded, and of the constants.

    `widths` are the sizes of the changes of variables along lines. `question` has the formulas that hold there (the
    branch of each `if`, `max` and others). `certain`: whether data can show this point; else it counts for doubt only.
    """

    variables: dict[sympy.Symbol, float]
    constants: dict[sympy.Symbol, float]
    widths: dict[sympy.Symbol, float]
    question: Question
    certain: bool = True
    tempo: float = 1.0
    """The unit of time of the series: about the time in which states change by their widths."""
    beside: tuple[Base, ...] = ()
    """Other trajectories at the same arguments of unknowns, for which conditions or inputs choose other formulas."""


@dataclass
class LinearSystem:
    """The residuals' coefficients, one row each, by columns: constants, then all others."""

    matrix: Array
    germs: list[Germ]
    constants: int
    starts: dict[str, int]
    """The first column of each unmeasured initial value, a polynomial in `parameters` minus their base values."""
    parameters: list[sympy.Symbol]
    own: dict[str, tuple[int, ...]]
    """The first column of each constant with a value per trajectory, for each trajectory beside the base point too."""
    sizes: Array
    """The natural size of each column's quantity: of a constant its value, of an initial value its width."""
    probes: Array
    """The residuals' coefficients for made-up terms of the rates, one column for each state."""
    certain: bool = True
    """Whether data can show the base point."""


@dataclass
class Columns:
    """Allocates columns; the constants have the first ones."""

    count: int

    def take(self, number: int) -> int:
        """The first of `number` new columns."""
        self.count += number
        return self.count - number


class Jet:
    """The expansion of a question at one base point; the functions are those of the expansion that it is `beside`."""

    def __init__(
        self,
        base: Base,
        algebra: Algebra,
        lines: int,
        rng: np.random.Generator,
        beside: Jet | None = None,
    ) -> None:
        question = base.question
        self._question, self._algebra, self._lines = question, algebra, lines
        model = question.model
        self._states = [s.symbol for s in model.states]
        self._base = base
        self._rng = rng
        self.germs: list[Germ] = [] if beside is None else beside.germs
        self._columns: Columns = Columns(len(question.sought)) if beside is None else beside._columns
        self._own_columns: dict[tuple[str, str], int] = {}
        self._parameters = [s for s, start in zip(self._states, question.starts, strict=True) if start is None]
        self._parameters += [c.symbol for c in model.conditions]
        if question.uses_time and model.time.start is None:
            self._parameters.append(model.time.symbol)
        self._lasting = len(self._parameters)
        """The number of parameters that starts and constants of a trajectory may depend on: all but signals."""
        self._parameters += [i.symbol for i in model.inputs] + [d.amount for d in question.doses]
        # Steps that follow each other fast come as close to a slope as one likes, so that held inputs have one too.
        self._slopes = [i.symbol for i in model.inputs]
        self._probes: int = self._columns.take(len(self._states)) if beside is None else beside._probes
        self._made: dict[int, Array] = {}
        variables = len(self._states) + len(model.conditions)
        self._factors = np.random.default_rng(variables).uniform(0.5, 1.5, (len(self._states), variables))
        self._unit = rng.normal(size=(lines, len(self._parameters) + len(self._slopes)))
        self._widths = np.array([base.widths[symbol] for symbol in (*self._parameters, *self._slopes)])
        self._widths *= 0.0 if question.alone else 1.0
        self._directions = algebra.numbers(self._unit) * algebra.numbers(self._widths)

    # -------------------------------------------------------------------------------------------------------- values

    def residuals(self) -> list[Array]:
        """All residuals at this base point; raises `OutOfEffortError` when the algebra's effort is spent."""
        starts = self._after_doses(self._start_values())
        values = dict(starts)
        for _ in range(self._algebra.time_order + 1):
            evaluation = self._evaluation(values)
            rates = [evaluation(rate) for rate in self._question.rates]
            values.update(
                (state, starts[state] + self._integral(rate)) for state, rate in zip(self._states, rates, strict=True)
            )
        return [row for row in self._residuals(self._evaluation(values)) if row.size]

    def system(self, others: Sequence[Jet] = ()) -> LinearSystem:
        """The residuals at this base point and of the expansions beside it."""
        rows = [row for jet in (self, *others) for row in jet.residuals()]
        width = self._columns.count
        padded = [np.concatenate([r, np.zeros((width - r.shape[0], r.shape[1]))]) for r in rows]
        matrix = np.concatenate(padded, axis=1).T if padded else np.zeros((0, width))
        constants, made_up = len(self._question.sought), slice(self._probes, self._probes + len(self._states))
        probes = matrix[:, made_up].copy()
        matrix[:, made_up] = 0.0
        sizes = np.ones(width)
        sizes[:constants] = [abs(self._base.constants[k.symbol]) or 1.0 for k in self._question.sought]
        own: dict[str, tuple[int, ...]] = {}
        for jet in (self, *others):
            jet._enter_sizes(sizes)
            for (kind, name), column in jet._own_columns.items():
                if kind == "own":
                    own[name] = (*own.get(name, ()), column)
        begun = {name: column for (kind, name), column in self._own_columns.items() if kind == "start"}
        parameters = self._parameters[: self._lasting]
        return LinearSystem(matrix, self.germs, constants, begun, parameters, own, sizes, probes, self._base.certain)

    def _enter_sizes(self, sizes: Array) -> None:
        """Enters the natural sizes of what is free for each trajectory; that of coefficients of germs is 1."""
        base, question = self._base, self._question
        count = len(monomials(self._lasting, self._algebra.order))
        of = {"start": {s.name: base.widths[s.symbol] for s in question.model.states}}
        of["own"] = {k.name: abs(base.constants[k.symbol]) for k in question.own}
        for (kind, name), column in self._own_columns.items():
            sizes[column : column + count] = of[kind][name] or 1.0

    def _start_values(self) -> dict[sympy.Symbol, Array]:
        algebra, model = self._algebra, self._question.model
        values: dict[sympy.Symbol, Array] = {}
        for symbol, value in (*self._base.constants.items(), *self._base.variables.items()):
            values[symbol] = algebra.constant(np.full(self._lines, value))
        along = algebra.index[0, 1] if algebra.order else None
        for column, symbol in enumerate(self._parameters):
            if along is not None:
                values[symbol][..., along] = self._directions[:, column]
        for column, symbol in enumerate(self._slopes, start=len(self._parameters)):
            if (1, 1) in algebra.index:
                values[symbol][..., algebra.index[1, 0]] = 0.5 * self._widths[column]  # per unit of the series' time
                values[symbol][..., algebra.index[1, 1]] = self._directions[:, column]
        if (1, 0) in algebra.index:
            clock = values[model.time.symbol]
            clock[..., algebra.index[1, 0]] = self._base.tempo
        waiting = {s: e for s, e in zip(self._states, self._question.starts, strict=True) if e is not None}
        while waiting:
            ready = [s for s, e in waiting.items() if not (e.free_symbols & set(waiting))]
            for state in ready:
                values[state] = Evaluation(algebra, values, self._lines)(waiting.pop(state))
        return values

    def _integral(self, rate: Array) -> Array:
        return self._base.tempo * self._algebra.integral(rate)

    def _jumps(self) -> dict[int, Expr]:
        """What doses add to the states, in values before them: amounts, and the effect of a change of the lag.

        A later dose lets the state before it go on for a while, and that after it for as much less.
        """
        found: dict[int, Expr] = {}
        question = self._question
        networks = {a.value for a in question.applications}
        for dose in question.doses:
            added = dose.fraction * dose.amount
            found[dose.state] = found.get(dose.state, sympy.S.Zero) + added
            late = dose.lag - dose.lag.xreplace({s: sympy.Float(v) for s, v in self._base.constants.items()})
            if not late.free_symbols:
                continue
            state = self._states[dose.state]
            for i, rate in enumerate(question.rates):
                difference = rate - rate.xreplace({state: state + added})
                if difference != 0 and not difference.free_symbols & networks:
                    found[i] = found.get(i, sympy.S.Zero) + late * difference
        return found

    def _after_doses(self, before: dict[sympy.Symbol, Array]) -> dict[sympy.Symbol, Array]:
        """The values at the start with what doses add."""
        after = dict(before)
        at_start = Evaluation(self._algebra, before, self._lines)
        for i, jump in self._jumps().items():
            after[self._states[i]] = before[self._states[i]] + at_start(jump)
        return after

    def _evaluation(self, values: dict[sympy.Symbol, Array]) -> Evaluation:
        """Values of all symbols; those of networks are added one after the other."""
        table = dict(values)
        evaluation = Evaluation(self._algebra, table, self._lines)
        self._powers: list[tuple[Germ, Array]] = []
        for application in self._question.applications:
            arguments = [evaluation(argument) for argument in application.arguments]
            germ = self._germ(application, arguments)
            powers = self._monomials(arguments, germ)
            self._powers.append((germ, powers))
            table[application.value] = np.tensordot(germ.coefficients, powers, axes=1)
        return evaluation

    def _germ(self, application: Application, arguments: Sequence[Array]) -> Germ:
        unknown, base = application.unknown, [float(a[0, 0]) for a in arguments]
        for germ in self.germs:
            if germ.unknown == unknown and np.allclose(germ.base, base, rtol=1e-9, atol=1e-12):
                return germ
        exponents = monomials(len(base), self._algebra.order)
        coefficients = self._rng.uniform(0.3, 1.0, size=len(exponents))
        coefficients *= self._rng.choice([-1.0, 1.0], size=len(exponents))
        coefficients[0] = abs(coefficients[0])
        free = np.ones(len(exponents), dtype=bool)
        given = np.zeros(len(exponents))
        for r, place, value in application.known:
            if abs(base[r] - float(place)) < 1e-9:  # monomials without this argument vanish, but for the value there
                free &= np.array([exponent[r] > 0 for exponent in exponents])
                given[0] = value
        column = self._columns.take(len(exponents))
        along = self._algebra.index.get((0, 1))
        spread = [0.0 if along is None else float(np.sqrt(np.mean(a[:, along] ** 2))) for a in arguments]
        widths = tuple(value if 0 < value < math.inf else 1.0 for value in spread)
        germ = Germ(unknown, tuple(base), widths, exponents, coefficients * free + given, column, free)
        self.germs.append(germ)
        return germ

    def _monomials(self, arguments: Sequence[Array], germ: Germ) -> Array:
        """Powers of the arguments minus their base values, by their widths, shape [monomials, lines, L]."""
        shifted = [
            (a - self._algebra.constant(np.full(self._lines, b))) / w
            for a, b, w in zip(arguments, germ.base, germ.widths, strict=True)
        ]
        return self._powers_of(shifted, germ.exponents)

    def _powers_of(self, shifted: Sequence[Array], exponents: Sequence[tuple[int, ...]]) -> Array:
        found: dict[tuple[int, ...], Array] = {}
        for exponent in exponents:
            r = next((r for r, e in enumerate(exponent) if e), None)
            if r is None:
                found[exponent] = self._algebra.constant(np.ones(self._lines))
            else:
                lower = (*exponent[:r], exponent[r] - 1, *exponent[r + 1 :])
                found[exponent] = self._algebra.times(shifted[r], found[lower])
        return np.stack([found[e] for e in exponents])

    # ------------------------------------------------------------------------------------------------------ directions

    def _residuals(self, evaluation: Evaluation) -> Iterator[Array]:
        """Rows as columns: arrays of shape [columns so far, number of coefficients]."""
        question, algebra = self._question, self._algebra
        starts = self._start_changes()
        changes = {i: starts[i] for i in question.hidden}
        networks = self._network_changes(evaluation, changes)
        for _ in range(algebra.time_order if question.hidden else 0):
            rates = {i: self._rate_change(i, evaluation, changes, networks) for i in question.hidden}
            changes = {i: self._sum(starts[i], self._integral(rates[i])) for i in question.hidden}
            networks = self._network_changes(evaluation, changes)
        for i in sorted(question.known):
            change = self._rate_change(i, evaluation, changes, networks)
            yield self._flat(change * (self._base.tempo / self._base.widths[self._states[i]]))
            if question.starts[i] is not None or question.doses:
                yield self._flat(starts[i] / self._base.widths[self._states[i]])
        for output in question.outputs:
            scale = float(np.max(np.abs(evaluation(output)))) or 1.0
            yield self._flat(self._change(output, evaluation, changes, networks) / scale)

    def _rate_change(
        self, i: int, evaluation: Evaluation, changes: dict[int, Array], networks: Sequence[Array]
    ) -> Array:
        """The change of a state's rate, with that by a made-up term."""
        change = self._change(self._question.rates[i], evaluation, changes, networks)
        if i in self._question.probed:
            if i not in self._made:
                self._made[i] = self._made_up(i, evaluation)
            change[self._probes + i] += self._made[i]
        return change

    def _made_up(self, i: int, evaluation: Evaluation) -> Array:
        """A term that could stand in the rate of state i, as a series of its size: e to a random linear form."""
        base, algebra = self._base, self._algebra
        form = algebra.constant(np.zeros(self._lines))
        symbols = [*self._states, *(c.symbol for c in self._question.model.conditions)]
        for symbol, factor in zip(symbols, self._factors[i], strict=True):
            series = evaluation(symbol)
            if base.widths[symbol] > 0:
                form = form + (factor / base.widths[symbol]) * (series - algebra.constant(series[:, 0]))
        return np.asarray((base.widths[self._states[i]] or 1.0) / base.tempo * algebra.exp(form))

    @staticmethod
    def _flat(change: Array) -> Array:
        return change.reshape(change.shape[0], math.prod(change.shape[1:]))  # none may have been sought yet

    def _zero(self) -> Array:
        return self._algebra.zeros((self._columns.count, self._lines, self._algebra.size))

    @staticmethod
    def _sum(a: Array, b: Array) -> Array:
        if a.shape[0] < b.shape[0]:
            a, b = b, a
        result = a.copy()
        result[: b.shape[0]] += b
        return result

    def _free(self, kind: str, name: str) -> Array:
        """A change that is free for each trajectory: a polynomial in the quantities that distinguish trajectories.

        Signals are not among them: after one past there may be any input, and any dose.
        """
        along = self._algebra.numbers(self._unit[:, : self._lasting] * (self._widths[: self._lasting] > 0))
        exponents = monomials(self._lasting, self._algebra.order)
        column = self._own_columns.get((kind, name))
        if column is None:
            column = self._own_columns[kind, name] = self._columns.take(len(exponents))
        result = self._zero()
        for k, exponent in enumerate(exponents):
            factor = np.prod(along ** np.array(exponent), axis=1)
            result[column + k, :, self._algebra.index[0, sum(exponent)]] = factor
        return result

    def _start_changes(self) -> dict[int, Array]:
        """Changes of initial values: free for unmeasured states, by the chain rule for expressions, else zero."""
        question = self._question
        at_start = Evaluation(self._algebra, self._start_values(), self._lines)
        found: dict[int, Array] = {}
        for i, start in enumerate(question.starts):
            if start is None:
                free = i in question.hidden
                found[i] = self._free("start", question.model.states[i].name) if free else self._zero()
        waiting = {i: e for i, e in enumerate(question.starts) if e is not None}
        while waiting:
            pending = {self._states[i] for i in waiting}
            for i in [i for i, e in waiting.items() if not (e.free_symbols & pending)]:
                found[i] = self._change(waiting.pop(i), at_start, found, [])
        jumps = {i: self._change(jump, at_start, found, []) for i, jump in self._jumps().items()}
        return {i: self._sum(change, jumps[i]) if i in jumps else change for i, change in found.items()}

    def _network_changes(self, evaluation: Evaluation, changes: dict[int, Array]) -> list[Array]:
        found: list[Array] = []
        for application, (germ, powers) in zip(self._question.applications, self._powers, strict=True):
            change = self._zero()
            change[germ.column : germ.column + len(germ.exponents)] = powers * germ.free[:, None, None]
            for r, argument in enumerate(application.arguments):
                inner = self._change(argument, evaluation, changes, found)
                if np.any(inner):
                    change = self._sum(change, self._algebra.times(self._slope(germ, powers, r), inner))
            found.append(change)
        return found

    def _slope(self, germ: Germ, powers: Array, r: int) -> Array:
        """The derivative of a germ by its argument r, as a series."""
        position = {e: k for k, e in enumerate(germ.exponents)}
        result = self._algebra.zeros(powers.shape[1:])
        for exponent, coefficient in zip(germ.exponents, germ.coefficients, strict=True):
            if exponent[r]:
                lower = (*exponent[:r], exponent[r] - 1, *exponent[r + 1 :])
                result += exponent[r] * coefficient * powers[position[lower]]
        return result / germ.widths[r]

    def _change(self, e: Expr, evaluation: Evaluation, changes: dict[int, Array], networks: Sequence[Array]) -> Array:
        """The change of an expression: of its constants, unmeasured states and networks; shape [columns, lines, L]."""
        question, algebra = self._question, self._algebra
        algebra.effort.spend(CHANGE)
        total = self._zero()
        present = e.free_symbols
        for column, learnable in enumerate(question.sought):
            if learnable.symbol in present:
                total[column] += evaluation(derivative(e, learnable.symbol))
        parts = {self._states[i]: change for i, change in changes.items()}
        parts.update((k.symbol, self._free("own", k.name)) for k in question.own if k.symbol in present)
        parts.update((a.value, c) for a, c in zip(question.applications, networks, strict=False))
        for symbol, change in parts.items():
            if symbol in present and np.any(change):
                total = self._sum(total, algebra.times(evaluation(derivative(e, symbol)), change))
        return total


def system_at(base: Base, algebra: Algebra, lines: int, rng: np.random.Generator) -> LinearSystem:
    """The system at a base point and for the trajectories beside it."""
    first = Jet(base, algebra, lines, rng)
    return first.system([Jet(other, algebra, lines, rng, first) for other in base.beside])


def size(question: Question, order: int) -> int:
    """The approximate number of columns of a jet of that order."""
    model = question.model
    space = len(model.states) + len(model.conditions)
    free = len(question.own) + sum(question.starts[i] is None for i in question.hidden)
    germs = sum(comb(order + len(a.arguments), order) for a in question.applications)
    return len(question.sought) + germs + free * comb(order + space, order)
