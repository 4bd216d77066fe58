"""Events: their conditions as guards, which change sign where the condition becomes true, and their order."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import sympy

from gbspec.diagnostics import Findings, Span
from gbspec.ir import NOISES, Channel, Event, Expr, Model, Timing, symbol
from gbspec.lower import waiting
from gbspec.semantics import Checked
from gbspec.syntax import ast, target_name

Lower = Callable[[ast.Expression], Expr]

MOST_CHOICES = 64
"""A condition with more combinations of values of its `if` is refused."""

_JUMPING = (sympy.Piecewise, sympy.sign, sympy.floor)
_GREATER = (sympy.StrictGreaterThan, sympy.GreaterThan)
_LESS = (sympy.StrictLessThan, sympy.LessThan)


def lowered(model: Model, checked: Checked, expression: Lower, fixed: Lower, findings: Findings) -> Model:
    """The model with its events, in the order in which they happen at one time, and its discrete values marked."""
    discretes = {
        i.statement.name.text for i in checked.source or checked.items if isinstance(i.statement, ast.DiscreteStatement)
    }
    states = tuple(replace(state, discrete=True) if state.name in discretes else state for state in model.states)
    model = replace(model, states=states)
    found: list[Event] = []
    for s in checked.all(ast.EventStatement):
        event = _Lowering(model, checked, expression, fixed, findings).event(s)
        wait = waiting.wait_of(s, checked, expression)
        if wait is None or findings.failed:
            found.append(event)
        else:
            model, made = waiting.with_waiting(model, event, wait, checked.table)
            found += made
    found.sort(key=lambda event: (event.timing is None, -event.priority))  # stable: else as written
    model = replace(model, events=tuple(found))
    _refuse_together(model, checked, findings)
    return model


class _Lowering:
    def __init__(self, model: Model, checked: Checked, expression: Lower, fixed: Lower, findings: Findings) -> None:
        self._model, self._checked, self._findings = model, checked, findings
        self._expression, self._fixed = expression, fixed
        moving = {state.symbol for state in model.states if not state.discrete}
        moving |= {item.symbol for item in model.algebraics}
        self._moving = moving | {item.symbol for item in model.inputs} | {model.time.symbol}

    def event(self, s: ast.EventStatement) -> Event:
        """The event of a statement."""
        values = tuple((target_name(a.target).text, self._expression(a.value)) for a in s.assignments)
        priority = self._checked.numbers.value(s.priority) if s.priority is not None else 0.0
        rank = None if s.priority is None or priority is not None else self._expression(s.priority)
        guard = condition = timing = None
        if s.condition is not None:
            condition = self._expression(s.condition)
            guard = self._guard(self._without_choices(condition, s), s.condition.span)
            self._can_change(guard, s)
        else:
            timing = self._timing(s)
        return Event(
            s.name.text,
            values,
            guard,
            condition,
            timing,
            priority or 0.0,
            rank,
            s.armed,
            description=s.description.value if s.description is not None else "",
            span=s.name.span,
        )

    def _guard(self, node: sympy.Basic, place: Span) -> Expr:
        """An expression that is positive or zero where the condition is true, and crosses zero where it changes.

        A comparison of values that only jump is 1 or -1, so that it never lies near zero.
        """
        if isinstance(node, sympy.And):
            return sympy.Min(*(self._guard(part, place) for part in node.args), evaluate=False)
        if isinstance(node, sympy.Or):
            return sympy.Max(*(self._guard(part, place) for part in node.args), evaluate=False)
        if isinstance(node, sympy.Not):
            return -self._guard(node.args[0], place)
        if node in (sympy.true, sympy.false):
            return sympy.Integer(1 if node == sympy.true else -1)
        if not self._inlined(node).free_symbols & self._moving:
            return sympy.Piecewise((1, node), (-1, True), evaluate=False)
        if isinstance(node, _GREATER):
            return node.lhs - node.rhs
        if isinstance(node, _LESS):
            return node.rhs - node.lhs
        self._findings.error(
            "GB350",
            "`==` between quantities that change continuously is true at single times only",
            place,
            help="write `>=` or `<=`: the event happens when the comparison becomes true",
        )
        return self._model.time.symbol  # so that nothing else is said about it

    def _without_choices(self, node: sympy.Basic, s: ast.EventStatement) -> sympy.Basic:
        """A condition without `if` and `sign` of what changes continuously, where the sides of a comparison would jump:
        as a condition for each of their values. Reports `floor`, and what else has too many of them."""
        jumping = [part for part in self._inlined(node).atoms(*_JUMPING) if self._moves(part)]
        if not jumping:
            return node
        many = math.prod(len(part.args) for part in jumping if isinstance(part, sympy.Piecewise)) > MOST_CHOICES
        steps = any(isinstance(part, sympy.floor) for part in jumping)
        if steps or many:
            assert s.condition is not None
            why = "jumps with `floor`, `ceil` or `mod`" if steps else "holds too many `if`"
            help = "write what happens at given times as `event … at 8 every 24`, other conditions without them"
            message = f"the condition of `{s.name.text}` {why}, which has no form yet"
            self._findings.error("GB362", message, s.condition.span, help=help)
            return sympy.StrictGreaterThan(self._model.time.symbol, 0)  # so that nothing else is said about it
        return self._expanded(self._inlined(node))

    def _expanded(self, node: sympy.Basic) -> sympy.Basic:
        if isinstance(node, sympy.And | sympy.Or | sympy.Not):
            return node.func(*map(self._expanded, node.args))
        part = next((each for each in sorted(node.atoms(*_JUMPING), key=_size) if self._moves(each)), None)
        if part is None:
            return node
        pairs = part.args if isinstance(part, sympy.Piecewise) else _signs(part.args[0])
        earlier: list[sympy.Basic] = []
        found = []
        for value, condition in pairs:
            held = [*earlier, condition, node.xreplace({part: value})]
            found.append(sympy.And(*map(self._expanded, held)))
            earlier.append(sympy.Not(condition))
        return sympy.Or(*found)

    def _moves(self, node: sympy.Basic) -> bool:
        """Whether an expression jumps while nothing else does."""
        deciding = [c for _, c in node.args] if isinstance(node, sympy.Piecewise) else [node]
        return any(part.free_symbols & self._moving for part in deciding)

    def _inlined(self, node: sympy.Basic) -> sympy.Basic:
        return self._model.inlined([node])[0]

    def _can_change(self, guard: Expr, s: ast.EventStatement) -> None:
        """Reports a condition in which nothing changes over time."""
        states = {state.symbol for state in self._model.states}
        if s.condition is not None and not self._inlined(guard).free_symbols & (self._moving | states):
            self._findings.error(
                "GB349",
                f"the condition of `{s.name.text}` never changes: it holds neither a state, nor an input, nor the time",
                s.condition.span,
                help="an event happens when its condition becomes true; to set a start use `initial`",
            )

    def _timing(self, s: ast.EventStatement) -> Timing:
        at, every, until = (None if part is None else self._fixed(part) for part in (s.at, s.every, s.until))
        numbers = {symbol(name): sympy.Float(value) for name, value in self._checked.constants.items()}
        start = self._number(at, numbers)
        size, end = self._number(every, numbers), self._number(until, numbers)
        if s.every is not None and not math.isnan(size) and size <= 0:
            message = f"`{s.name.text}` happens every {size:g}, which is not positive"
            self._wrong(message, s.every.span, "give the time between two of them, e.g. `every 24`")
        elif s.until is not None and s.every is None:
            self._wrong(f"`{s.name.text}` happens once, so that `until` says nothing", s.until.span, "add `every …`")
        elif s.until is not None and end < start:
            self._wrong(f"`{s.name.text}` never happens: {end:g} lies before {start:g}", s.until.span)
        return Timing(at, every, until)

    def _number(self, value: Expr | None, numbers: dict[sympy.Symbol, Expr]) -> float:
        """The number that an expression of constants is; NaN for any other."""
        found = None if value is None else value.xreplace(numbers)
        return float(found) if found is not None and found.is_number and found.is_real else math.nan

    def _wrong(self, message: str, place: Span, help: str = "") -> None:
        self._findings.error("GB352", message, place, help=help)


def _size(node: sympy.Basic) -> tuple[int, object]:
    """An order in which what contains another comes after it."""
    return int(node.count_ops()), sympy.default_sort_key(node)


def _signs(argument: Expr) -> tuple[tuple[Expr, sympy.Basic], ...]:
    """The values of `sign`, each with its condition."""
    above, below = argument > 0, argument < 0
    return (sympy.S.One, above), (sympy.S.NegativeOne, below), (sympy.S.Zero, sympy.true)


def _refuse_together(model: Model, checked: Checked, findings: Findings) -> None:
    """Errors for what is not offered together with events (GB351)."""
    if not model.events:
        return
    for learnable in model.learnables:
        if learnable.distribution is not None:
            help = "leave out `~ …`, so that each trajectory has a value of its own, or leave out the events"
            message = f"`{learnable.name}` is distributed between trajectories, which events do not offer yet"
            findings.error("GB351", message, learnable.span, help=help)
    learned = {k.symbol for k in model.learnables}
    for channel in model.channels:
        noise = channel.noise
        if noise is not None and noise.value is not None:
            holds = (
                "holds learned constants" if noise.value.free_symbols & learned else "depends on the predicted value"
            )
            form = NOISES[noise.kind]
            why = f"is {form.whose}" if form.density else holds
            message = f"the noise of `{channel.name}` {why}, which events do not offer yet"
            help = "write `noise normal(…)` or `noise lognormal(…)` with a number, or leave out the events"
            findings.error("GB351", message, channel.span, help=help + _counted(model, channel, checked))


def _counted(model: Model, channel: Channel, checked: Checked) -> str:
    """What to observe without events where one empties a count at given times, as that of the cases of a week."""
    emptied = {name: event.name for event in model.events if event.timing is not None for name, _ in event.values}
    seen = {one.name for one in channel.value.free_symbols}
    balances = {target_name(s.target).text: s.span for s in checked.all(ast.BalanceStatement)}
    for name in sorted(emptied.keys() & seen & balances.keys()):
        rate = balances[name].text.partition("=")[2].strip()
        return (
            f"; without `event {emptied[name]}`, `observe {channel.name}` may have such a noise with the rate of"
            f" `{name}` in place of `{name}` (`{rate}`, what is counted in a unit of time), or with `{name}` as the sum"
            " from the start, which the table then has to hold"
        )
    return ""
