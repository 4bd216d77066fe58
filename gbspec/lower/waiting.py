"""Events that wait: `after`, `queue`, `transient` and `sampled` as events and discrete values without them.

`event a when C after d: x = v` becomes `a_begins`, which keeps the time `a_due` at which it acts and `a_waits` = 1, and
`a`, which happens when that time has come. So everything that covers events covers these, with exact derivatives of the
delayed time, and a solution can be begun or cut anywhere, since what waits is part of the state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container
from dataclasses import dataclass, replace

import sympy

from gbspec.ir import Event, Expr, Initial, Model, State, symbol
from gbspec.semantics import Checked
from gbspec.syntax import ast

_HALF = sympy.Rational(1, 2)


@dataclass(frozen=True)
class Wait:
    """How an event waits."""

    delay: Expr
    queue: int = 1
    transient: bool = False
    sampled: bool = False


def wait_of(s: ast.EventStatement, checked: Checked, lower: Callable[[ast.Expression], Expr]) -> Wait | None:
    """How the event of a statement waits; None if it does not."""
    if s.after is None and not s.transient and not s.sampled:
        return None
    queue = checked.numbers.value(s.queue)
    delay = sympy.S.Zero if s.after is None else lower(s.after)
    return Wait(delay, 1 if queue is None else int(queue), s.transient, s.sampled)


def with_waiting(model: Model, event: Event, wait: Wait, taken: Container[str]) -> tuple[Model, tuple[Event, ...]]:
    """The model with the discrete values that an event needs to wait, and the events that are carried out for it."""
    made = _Waiting(model, event, wait, taken)
    states = (*model.states, *made.states)
    balances = (*model.balances, *(sympy.S.Zero for _ in made.states))
    return replace(model, states=states, balances=balances), made.events


class _Waiting:
    def __init__(self, model: Model, event: Event, wait: Wait, taken: Container[str]) -> None:
        self.model, self.event, self.wait, self.taken = model, event, wait, taken
        self.states: list[State] = []
        places = [self._place(number) for number in range(1, wait.queue + 1)]
        acting = tuple(self._acting(number, *place) for number, place in enumerate(places, 1))
        ending = (self._ending(places[0][0]),) if wait.transient else ()
        self.events = (self._beginning(places), *ending, *acting)

    def _place(self, number: int) -> tuple[sympy.Symbol, sympy.Symbol, dict[str, sympy.Symbol]]:
        """Whether one of the event waits, when it acts, and what its values will be."""
        name, which = self.event.name, str(number) if self.wait.queue > 1 else ""
        waits = self._state(f"{name}_waits{which}", None, f"whether `{name}` waits")
        due = self._state(f"{name}_due{which}", self.model.time.unit, f"when `{name}` acts")
        units = {state.name: state.unit for state in self.model.states}
        kept = {
            target: self._state(f"{name}_{target}{which}", units[target], f"what `{name}` sets `{target}` to")
            for target, _ in (self.event.values if self.wait.sampled else ())
        }
        return waits, due, kept

    def _state(self, name: str, unit: str | None, description: str) -> sympy.Symbol:
        while name in self.taken or any(name == state.name for state in (*self.model.states, *self.states)):
            name += "_"
        initial = Initial("expression", sympy.S.Zero)
        self.states.append(State(name, unit=unit, description=description, initial=initial, discrete=True))
        return symbol(name)

    def _beginning(self, places: list[tuple[sympy.Symbol, sympy.Symbol, dict[str, sympy.Symbol]]]) -> Event:
        """Takes the first free place. Where there is none the solution ends, since nothing may be lost in silence: the
        logarithm of a negative number has no value."""
        values: list[tuple[str, Expr]] = []
        time = self.model.time.symbol + self.wait.delay
        before: list[sympy.Basic] = []
        for number, (waits, due, kept) in enumerate(places, 1):
            mine = sympy.And(*before, waits < _HALF)
            last = number == len(places) and not self.wait.transient
            full = [(sympy.log(_HALF - waits), sympy.And(*before, waits > _HALF))] if last else []
            values.append((waits.name, self._chosen(mine, sympy.S.One, waits)))
            values.append((due.name, sympy.Piecewise((time, mine), *full, (due, True), evaluate=False)))
            for target, value in self.event.values if kept else ():
                values.append((kept[target].name, self._chosen(mine, value, kept[target])))
            before.append(waits > _HALF)
        name, first = self._free(f"{self.event.name}_begins"), math.inf
        return replace(self.event, name=name, values=tuple(values), priority=first, rank=None)

    @staticmethod
    def _chosen(condition: sympy.Basic, value: Expr, other: Expr) -> Expr:
        return sympy.Piecewise((value, condition), (other, True), evaluate=False)

    def _ending(self, waits: sympy.Symbol) -> Event:
        """What waits is given up when the condition ends."""
        assert self.event.guard is not None and self.event.condition is not None
        return Event(
            self._free(f"{self.event.name}_ends"),
            ((waits.name, sympy.S.Zero),),
            -self.event.guard,
            sympy.Not(self.event.condition),
            priority=math.inf,
            span=self.event.span,
        )

    def _acting(self, number: int, waits: sympy.Symbol, due: sympy.Symbol, kept: dict[str, sympy.Symbol]) -> Event:
        """Sets the values when the time has come. One that was given up at that very time sets nothing."""
        time = self.model.time.symbol
        values = [(target, kept.get(target, value)) for target, value in self.event.values]
        if self.wait.transient:
            values = [(target, self._chosen(waits > _HALF, value, symbol(target))) for target, value in values]
        return replace(
            self.event,
            name=self.event.name if number == 1 else self._free(f"{self.event.name}_{number}"),
            values=(*values, (waits.name, sympy.S.Zero)),
            guard=self._chosen(waits > _HALF, time - due, sympy.S.NegativeOne),
            condition=sympy.And(waits > _HALF, time >= due),
            armed=False,
        )

    def _free(self, name: str) -> str:
        while name in self.taken or any(name == event.name for event in self.model.events):
            name += "_"
        return name
