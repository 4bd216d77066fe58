"""The identifiability question of a Model: its right sides in terms of constants and function values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir import NN, Condition, Expr, Learnable, Model, Range, Unknown, symbol


@dataclass(frozen=True)
class Application:
    """One application of an unknown: the symbol of its network's value, and the arguments."""

    unknown: str
    value: sympy.Dummy
    arguments: tuple[Expr, ...]
    known: tuple[tuple[int, Expr, float], ...] = ()
    """Known values of the network (contracts `zero at`, `equals … at`): the index of an argument, its value, and that
    of the network."""


@dataclass(frozen=True)
class Arrival:
    """A dose as a given signal: what it adds to a state, `amount*fraction`, `lag` later. The amount is known."""

    state: int
    amount: sympy.Dummy
    fraction: Expr
    lag: Expr


@dataclass(frozen=True)
class Question:
    """The variables, the sought parameters and the outputs.

    `known` are the states that are measured directly; `hidden` the others. `starts` has the expression of a state's
    initial value, None if it is free. `rates` and `outputs` are in symbols of states, variables, constants and the
    values of applications. `outputs` are the measured expressions that are not states.
    """

    model: Model
    applications: tuple[Application, ...]
    rates: tuple[Expr, ...]
    outputs: tuple[Expr, ...]
    known: frozenset[int]
    starts: tuple[Expr | None, ...]
    doses: tuple[Arrival, ...] = ()
    alone: bool = False
    """Whether there is one trajectory only: no initial value, condition or input differs."""

    @cached_property
    def hidden(self) -> tuple[int, ...]:
        """States that are not measured directly."""
        return tuple(i for i in range(len(self.model.states)) if i not in self.known)

    @cached_property
    def sought(self) -> tuple[Learnable, ...]:
        """Learnables, one value for all trajectories, without those that have a prior; of a distribution its median."""
        return tuple(k for k in self.model.learnables if k.prior is None and _shared(k) and k.symbol in self._used)

    @cached_property
    def _used(self) -> frozenset[sympy.Symbol]:
        """What the solution and its measurements depend on, and all that no noise, disturbance or spread depends on.

        The analysis does not reach noises and distributions: what only these contain is undecided.
        """
        elsewhere = {
            s
            for c in self.model.channels
            if c.noise
            for e in (c.noise.value, c.noise.shape)
            if e is not None
            for s in e.free_symbols
        }
        elsewhere |= {s for diffusion in self.model.diffusions for s in diffusion.value.free_symbols}
        for made in (k.distribution for k in self.model.distributed if k.distribution is not None):
            spreads = made.spread, *(level.spread for level in made.levels)
            elsewhere |= {symbol(name) for name in spreads if name}
        starts = [e for e in self.starts if e is not None]
        terms = [*self.rates, *self.outputs, *self._arguments, *starts]
        inside = {s for e in terms for s in e.free_symbols} | {
            s for d in self.doses for e in (d.fraction, d.lag) for s in e.free_symbols
        }
        return frozenset(k.symbol for k in self.model.learnables if k.symbol in inside or k.symbol not in elsewhere)

    @cached_property
    def own(self) -> tuple[Learnable, ...]:
        """Learnables with a value for each trajectory."""
        return tuple(
            k for k in self.model.learnables if k.prior is None and k.per_trajectory and k.distribution is None
        )

    @cached_property
    def signals(self) -> frozenset[sympy.Symbol]:
        """Inputs and amounts of doses, which may differ at one state: no start and no constant depends on them."""
        return frozenset((*(i.symbol for i in self.model.inputs), *(d.amount for d in self.doses)))

    @cached_property
    def probed(self) -> frozenset[int]:
        """The states whose rate has no unknown function of all states and of all conditions that expansions vary.

        Such a function compensates whatever may stand beside it, however many derivatives are known; along a single
        trajectory a function of time alone does so too. Categories are not varied.
        """
        model = self.model
        every = {s.symbol for s in model.states} | {c.symbol for c in model.conditions if not c.categories}
        if self.alone:
            every = {model.time.symbol}
        free: set[sympy.Symbol] = set()
        for application in self.applications:  # inner ones first: a function of a free one is free too
            inside = {s for e in application.arguments for s in e.free_symbols}
            if every <= inside or inside & free:
                free.add(application.value)
        return frozenset(i for i, rate in enumerate(self.rates) if not rate.free_symbols & free)

    @property
    def uses_time(self) -> bool:
        """Whether the time occurs in any expression."""
        return any(self.model.time.symbol in e.free_symbols for e in (*self.rates, *self.outputs, *self._arguments))

    @property
    def _arguments(self) -> list[Expr]:
        return [argument for a in self.applications for argument in a.arguments]


def _shared(learnable: Learnable) -> bool:
    """Whether a learnable is one number for all trajectories, or has a median that is."""
    found = learnable.distribution
    return not learnable.per_trajectory if found is None else found.kind != "standard"


def _draws(model: Model) -> dict[Learnable, Condition]:
    """What a distribution draws for each trajectory, as a condition, for each constant that differs so.

    Data tell no more than if each trajectory's draw were known: what cannot be told apart then never can.
    """
    return {k: Condition(f"draw of {k.name}", range=Range(-2.0, 2.0)) for k in model.distributed}


def _value(learnable: Learnable, draw: Expr) -> Expr:
    """The value of a trajectory, by the median and a draw on the scale of the distribution."""
    kind = learnable.distribution.kind if learnable.distribution is not None else "standard"
    median, low, high = learnable.symbol, learnable.range.low, learnable.range.high
    if kind == "logitnormal":
        odds = (median - low) / (high - median) * sympy.exp(draw)
        return low + (high - low) * odds / (1 + odds)
    return {"lognormal": median * sympy.exp(draw), "normal": median + draw, "standard": draw}[kind]


def pose(model: Model, *, all_states: bool) -> Question:
    """The question with all states measured and all initial values free, or as declared by `observe` and `initial`."""
    channels = [c.value for c in model.channels if c.state is None]
    added = [e for dose in model.doses for e in (dose.fraction, dose.lag)]
    expressions = model.inlined([*model.balances, *channels, *added])
    draws = _draws(model)
    drawn = {k.symbol: _value(k, draw.symbol) for k, draw in draws.items()}
    table, applications = _applications(model, expressions, drawn)
    opened = [e.xreplace(table).xreplace(drawn) for e in expressions]
    n = len(model.states)
    measured = {c.state for c in model.channels if c.state is not None}
    known = frozenset(range(n)) if all_states else frozenset(measured)
    given = [s.initial.value if s.initial.kind == "expression" and not all_states else None for s in model.states]
    starts = tuple(None if start is None else start.xreplace(drawn) for start in given)
    m = n + len(channels)
    doses = tuple(
        Arrival(model.state_index[dose.state], sympy.Dummy(f"dose_{dose.state}", real=True), fraction, lag)
        for dose, fraction, lag in zip(model.doses, opened[m::2], opened[m + 1 :: 2], strict=True)
    )
    whole = replace(model, conditions=(*model.conditions, *draws.values())) if draws else model
    return Question(whole, applications, tuple(opened[:n]), tuple(opened[n:m]), known, starts, doses)


def pose_disturbed(model: Model) -> Question:
    """The question with all states measured, where random disturbances lead them anywhere, with what such data show
    besides: the starts that are expressions, and the sizes of the disturbances."""
    everywhere, declared = pose(model, all_states=True), pose(model, all_states=False)
    given = {s.symbol: e for s, e in zip(model.states, declared.starts, strict=True) if e is not None}
    clock = {} if model.time.start is None else {model.time.symbol: sympy.Float(model.time.start)}
    starts = []
    for start in given.values():
        value = start
        while value.free_symbols & given.keys():  # a start by other starts
            value = value.xreplace(given)
        starts.append(value.xreplace(clock))
    drawn = {k.symbol: _value(k, draw.symbol) for k, draw in _draws(model).items()}
    sizes = [size.xreplace(drawn) for size in model.inlined([d.value for d in model.diffusions])]
    return replace(everywhere, outputs=(*everywhere.outputs, *starts, *sizes))


def _applications(
    model: Model, expressions: Sequence[Expr], drawn: Mapping[Expr, Expr]
) -> tuple[dict[Expr, Expr], tuple[Application, ...]]:
    """Each distinct application, inner ones first, and its replacement: its postulate with a symbol for `nn`; in its
    arguments distributed constants are replaced by what is `drawn`."""
    found: set[Expr] = set()
    for expression in expressions:
        found |= expression.atoms(AppliedUndef)
    unknowns = {u.name: u for u in model.unknowns}
    table: dict[Expr, Expr] = {}
    applications = []
    for application in sorted(found, key=lambda a: (len(a.atoms(AppliedUndef)), sympy.default_sort_key(a))):
        name = application.func.__name__
        unknown = unknowns[name]
        formals = [a.symbol for a in model.networks[unknown.network].arguments]
        arguments = tuple(argument.xreplace(table) for argument in application.args)
        value = sympy.Dummy(f"nn_{name}", real=True)
        table[application] = unknown.postulate.xreplace({**dict(zip(formals, arguments, strict=True)), NN: value})
        own = tuple(argument.xreplace(drawn) for argument in arguments)
        applications.append(Application(name, value, own, _known_values(unknown, model)))
    return table, tuple(applications)


def _known_values(unknown: Unknown, model: Model) -> tuple[tuple[int, Expr, float], ...]:
    """The values by the contracts of an unknown without a postulate, where places and values are known numbers."""
    if unknown.postulate != NN:
        return ()
    names = [a.name for a in model.networks[unknown.network].arguments]
    known = {c.symbol: sympy.Float(c.value) for c in model.constants}
    places = [
        (names.index(c.argument), c.value.xreplace(known), sympy.Float(0.0) if c.to is None else c.to.xreplace(known))
        for c in unknown.contracts
        if c.kind in ("zero", "equals") and c.argument is not None and c.value is not None
    ]
    return tuple((r, place, float(value)) for r, place, value in places if place.is_number and value.is_number)
