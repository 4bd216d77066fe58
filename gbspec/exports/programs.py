"""The equations of a model as lists of operations and network calls, from which all exports are written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import sympy
from sympy.core.function import AppliedUndef
from sympy.core.relational import Relational

from gbspec.backends import Flat, NotCoveredError, Operation, flatten
from gbspec.ir import Algebraic, Event, Expr, Model, State, Unknown, unknown_function

MOST_OPERATIONS = 20_000
"""Most operations of one function: compilers take minutes for straight code that is longer."""
MOST_CALLS = 2_000
"""Most network calls of one function."""


@dataclass(frozen=True)
class Application:
    """An application of an unknown in the model's equations: `label` is its name there, `phi` or `phi[2]`."""

    unknown: Unknown
    node: Expr
    label: str


@dataclass(frozen=True)
class Search:
    """Equations that are solved together: `residual` is what is left of them, `variables` are those sought, of which
    the first has the place `first` among all algebraic variables."""

    first: int
    variables: tuple[Algebraic, ...]
    residual: Flat


class Programs:
    """The functions of a model, each flattened once. Raises NotCoveredError for what no export can express.

    `events`, `algebraics`: whether the form carries out events, and solves equations.
    """

    def __init__(self, model: Model, *, events: bool = False, algebraics: bool = False) -> None:
        if model.events and not events:
            raise NotCoveredError("it has events, which graphs of operations cannot carry out")
        if model.algebraics and not algebraics:
            raise NotCoveredError("it has algebraic variables, for which graphs of operations can seek no solution")
        if model.steady is not None:
            raise NotCoveredError("it starts in a steady state, which no exported program finds yet")
        self.model = model

    @cached_property
    def rhs(self) -> Flat:
        """The time derivative of each state."""
        return self._flat(self.model.balances)

    @cached_property
    def observe(self) -> Flat:
        """Each channel."""
        return self._flat([channel.value for channel in self.model.channels])

    @cached_property
    def initial(self) -> Flat:
        """The initial value of each state; that of another state is its value before."""
        values = {s.symbol: s.initial.value for s in self.model.states if s.initial.value is not None}
        out = []
        for state in self.model.states:
            value = values.get(state.symbol, state.symbol)
            while value is not state.symbol and value.free_symbols & values.keys():
                value = value.xreplace(values)
            out.append(value)
        return self._flat(out)

    @cached_property
    def lag_values(self) -> tuple[Expr, ...]:
        """How long delays are, each length once."""
        return tuple(dict.fromkeys(delay.lag for delay in self.model.delays))

    @property
    def lag_of(self) -> tuple[int, ...]:
        """Of each delay the place of its length."""
        return tuple(self.lag_values.index(delay.lag) for delay in self.model.delays)

    @cached_property
    def lags(self) -> Flat:
        """Those lengths."""
        return self._flat(self.lag_values)

    @cached_property
    def delayed(self) -> Flat:
        """What each delay delays, at its own time."""
        return self._flat([delay.value for delay in self.model.delays])

    @cached_property
    def history(self) -> Flat:
        """Every state before the start, of that at the start."""
        return self._flat([s.symbol if s.history is None else s.history for s in self.model.states])

    @cached_property
    def searches(self) -> tuple[Search, ...]:
        """The searches for algebraic variables, each of which knows what those before it found."""
        variables = {item.name: item for item in self.model.algebraics}
        equations = {item.name: item.residual for item in self.model.constraints}
        found, first = [], 0
        for block in self.model.blocks:
            if not block.explicit:
                flat = self._flat([equations[name] for name in block.equations])
                found.append(Search(first, tuple(variables[name] for name in block.variables), flat))
                first += len(block.variables)
        return tuple(found)

    @cached_property
    def _everything(self) -> tuple[Expr, ...]:
        """All that is computed at a time: balances, channels, and what is left of equations that need a search."""
        sought = {name for block in self.model.blocks if not block.explicit for name in block.equations}
        left = [equation.residual for equation in self.model.constraints if equation.name in sought]
        channels = [channel.value for channel in self.model.channels]
        return self.model.inlined((*self.model.balances, *channels, *left))

    @cached_property
    def switches(self) -> Flat:
        """Those quantities."""
        return self._flat(self.switched)

    @cached_property
    def switched(self) -> list[Expr]:
        """The quantities whose signs decide which branches are taken: differences of the sides of comparisons, and what
        is 0 where the argument of a `floor` is a whole number."""
        found: dict[Expr, None] = {}
        for value in self._everything:
            for step in sorted(value.atoms(sympy.floor), key=sympy.default_sort_key):
                found[sympy.sin(sympy.pi * step.args[0])] = None
            for choice in sorted(value.atoms(sympy.Piecewise), key=sympy.default_sort_key):
                for _, condition in choice.args:
                    for relation in sorted(condition.atoms(Relational), key=sympy.default_sort_key):
                        if not isinstance(relation, sympy.Eq | sympy.Ne):
                            found[sympy.Add(relation.lhs, sympy.Mul(-1, relation.rhs))] = None
        groups = (self.model.states, self.model.inputs, self.model.algebraics, self.model.delays)
        moving = {item.symbol for group in groups for item in group}
        moving.add(self.model.time.symbol)
        return [value for value in found if value.free_symbols & moving]

    @cached_property
    def conditional(self) -> tuple[Event, ...]:
        """The events with a condition; those at given times come before them."""
        return tuple(event for event in self.model.events if event.guard is not None)

    @cached_property
    def timed(self) -> tuple[Event, ...]:
        """The events at given times."""
        return tuple(event for event in self.model.events if event.timing is not None)

    @cached_property
    def guards(self) -> Flat:
        """A number for each event with a condition, positive or zero where it is true."""
        return self._flat([event.guard for event in self.conditional if event.guard is not None])

    @cached_property
    def ranks(self) -> Flat:
        """The priority of each event."""
        events = (*self.timed, *self.conditional)
        return self._flat([sympy.Float(e.priority) if e.rank is None else e.rank for e in events])

    @cached_property
    def happen(self) -> Flat:
        """Every state after each event."""
        out = []
        for event in (*self.timed, *self.conditional):
            values = dict(event.values)
            out += [values.get(state.name, state.symbol) for state in self.model.states]
        return self._flat(out)

    @cached_property
    def timing(self) -> Flat:
        """For each timed event its first time (NaN: the start), its interval (0: once) and its last time."""
        out: list[Expr] = []
        for event in self.timed:
            assert event.timing is not None
            parts = (event.timing.at, event.timing.every, event.timing.until)
            absent = (sympy.nan, sympy.S.Zero, sympy.oo)
            out += [other if part is None else part for part, other in zip(parts, absent, strict=True)]
        return self._flat(out)

    @cached_property
    def doses(self) -> Flat:
        """For each dose the fraction of it that arrives, then its lag."""
        return self._flat([part for dose in self.model.doses for part in (dose.fraction, dose.lag)])

    @cached_property
    def applications(self) -> tuple[Application, ...]:
        """All applications of unknowns in balances and channels, in the order of the unknowns."""
        model = self.model
        if not model.unknowns:
            return ()
        found: dict[str, set[Expr]] = {}
        for value in self._everything:
            for node in value.atoms(AppliedUndef):
                found.setdefault(node.func.__name__, set()).add(node)
        out = []
        for unknown in model.unknowns:
            nodes = sorted(found.get(unknown.name, ()), key=sympy.default_sort_key)
            for i, node in enumerate(nodes):
                out.append(Application(unknown, node, unknown.name if len(nodes) == 1 else f"{unknown.name}[{i + 1}]"))
        return tuple(out)

    @cached_property
    def functions(self) -> Flat:
        """The value of each application of an unknown."""
        return self._flat([item.node for item in self.applications])

    @cached_property
    def arguments(self) -> Flat:
        """The arguments of each application, one after the other."""
        return self._flat([argument for item in self.applications for argument in item.node.args])

    def unknown(self, unknown: Unknown) -> Flat:
        """The value of an unknown at arguments, which are leaves of the kind `state`."""
        formals = self.model.networks[unknown.network].arguments
        names = {argument.name for argument in formals}
        shadowed = replace(
            self.model,
            states=tuple(State(argument.name) for argument in formals),
            conditions=tuple(item for item in self.model.conditions if item.name not in names),
            inputs=tuple(item for item in self.model.inputs if item.name not in names),
            algebraics=(),
        )
        if self.model.time.name in names:
            shadowed = replace(shadowed, time=replace(shadowed.time, name=" none"))
        return flatten(shadowed, [unknown_function(unknown.name)(*(a.symbol for a in formals))])

    def dependencies(self, flat: Flat) -> list[set[sympy.Symbol]]:
        """For each output the leaves that it depends on; an algebraic variable counts by those of its equations.

        A condition counts, the point of a contract does not.
        """
        return [set[sympy.Symbol]().union(*map(self.behind, found)) for found in _reached(flat)]

    def before(self, symbols: Iterable[sympy.Symbol]) -> set[sympy.Symbol]:
        """What quantities depend on at the start, where delayed values come from the states' history."""
        found = set(symbols)
        for i, delay in enumerate(self.model.delays):
            if delay.symbol in found:
                read = {self.model.time.symbol, *self.dependencies(self.lags)[self.lag_of[i]]}
                histories = self.dependencies(self.history)
                for one in self.dependencies(self.delayed)[i]:
                    index = self.model.state_index.get(one.name)
                    read |= {one} if index is None else histories[index]
                found = (found - {delay.symbol}) | read
        return found

    def behind(self, symbol: sympy.Symbol) -> set[sympy.Symbol]:
        """What an algebraic variable depends on; of another quantity itself."""
        return self._behind.get(symbol, {symbol})

    @cached_property
    def _behind(self) -> dict[sympy.Symbol, set[sympy.Symbol]]:
        """What each algebraic variable depends on."""
        table: dict[sympy.Symbol, set[sympy.Symbol]] = {}
        for search in self.searches:
            own = {item.symbol for item in search.variables}
            read = set[sympy.Symbol]().union(*_reached(search.residual)) - own
            found = set[sympy.Symbol]().union(*(table.get(s, {s}) for s in read))
            table |= dict.fromkeys(own, found)
        return table

    def _flat(self, outputs: Sequence[Expr]) -> Flat:
        return flatten(self.model, outputs, MOST_OPERATIONS, MOST_CALLS)


def _reached(flat: Flat) -> list[frozenset[sympy.Symbol]]:
    """For each output the leaves that it is computed from."""
    reached: dict[sympy.Basic, frozenset[sympy.Symbol]] = {
        symbol: frozenset([symbol]) for symbol, leaf in flat.leaves.items() if leaf.kind != "number"
    }
    nothing: frozenset[sympy.Symbol] = frozenset()
    for step in flat.steps:
        if isinstance(step, Operation):
            reached[step.symbol] = nothing.union(*(reached.get(s, nothing) for s in step.value.free_symbols))
        else:
            found = nothing.union(*(reached.get(a, nothing) for a in step.arguments))
            reached.update(dict.fromkeys(step.results, found))
    return [reached.get(output, nothing) for output in flat.outputs]
