"""Delays: one symbol for each value of a time ago, and what may not occur in them or beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import sympy
from sympy.core.function import AppliedUndef

from gbspec.diagnostics import Findings, Span
from gbspec.ir import Delay, Expr, Model, symbol
from gbspec.passes import least_value
from gbspec.semantics import Checked
from gbspec.syntax import ast, target_name


class Delays:
    """The delays of a model in the order in which they are met; equal ones have one symbol."""

    def __init__(self, findings: Findings) -> None:
        self._findings = findings
        self._found: dict[tuple[Expr, Expr], Delay] = {}

    def symbol(self, call: ast.Call, what: Expr, lag: Expr) -> Expr:
        """The symbol of a delayed value; `lag` may hold intermediates."""
        found = self._found.get((what, lag))
        if found is None:
            text = str(lag).replace("**", "^")
            name = f"delay({what}, {text})"
            while any(name == other.name for other in self._found.values()):
                name += "'"
            found = self._found[what, lag] = Delay(name, str(what), lag, span=call.span)
        return found.symbol

    def completed(self, model: Model, checked: Checked, fixed: Callable[[ast.Expression], Expr]) -> Model:
        """The model with its delays and histories; reports what is wrong with them (GB366 to GB373)."""
        histories = {target_name(s.target).text: s for s in checked.all(ast.HistoryStatement)}
        values = {name: fixed(s.value) for name, s in histories.items()}
        states = tuple(replace(s, history=values.get(s.name)) for s in model.states) if values else model.states
        model = replace(model, states=states, delays=tuple(self._found.values()))
        lags = model.inlined([delay.lag for delay in model.delays])
        sound = [self._sound(model, delay, lag) for delay, lag in zip(model.delays, lags, strict=True)]
        model = replace(model, delays=tuple(sound))
        self._unseen(model, {name: s.target.span for name, s in histories.items()})
        if model.delays:
            self._misplaced(model)
            _refuse_together(model, checked, self._findings)
        return model

    def _sound(self, model: Model, delay: Delay, lag: Expr) -> Delay:
        """The delay with its bound; reports a time that varies, or that may be zero."""
        known = {symbol(name) for name in model.constant_names}
        others = sorted(s.name for s in lag.free_symbols - known - {c.symbol for c in model.conditions})
        others += sorted({a.func.__name__ for a in lag.atoms(AppliedUndef)})
        if others:
            message = f"the time of a delay depends on `{others[0]}`, so that it varies within a trajectory"
            help = "it may hold constants, learnable constants and conditions"
            self._findings.error("GB366", message, delay.span, help=help)
            return replace(delay, lag=sympy.S.One)
        if {d.symbol for d in model.delays} & model.inlined([delay.value])[0].free_symbols:
            message = f"`{delay.source}` holds a delay, and a delay of something delayed is not offered"
            help = f"delay the states in `{delay.source}` instead, each by the sum of both times"
            self._findings.error("GB368", message, delay.span, help=help)
        least = least_value(model, lag)
        if not least > 0 and not lag.free_symbols & {c.symbol for c in model.conditions}:
            self._too_short(model, delay, lag, least)
        return replace(delay, lag=lag, least=least)

    def _too_short(self, model: Model, delay: Delay, lag: Expr, least: float) -> None:
        learned = [k.name for k in model.learnables if k.symbol in lag.free_symbols]
        if not learned:
            message, help = f"the time of a delay is {least:g}, and it must be positive", "a delay looks back in time"
        else:
            which = " and ".join(f"`{name}`" for name in learned)
            message = f"the bounds of {which} let the delay be zero or less"
            help = f"give a lower bound above 0: `learn {learned[0]} = 1 in [0.1, 10]`"
        self._findings.error("GB367", message, delay.span, help=help)

    def _unseen(self, model: Model, places: Mapping[str, Span]) -> None:
        """Warns of histories that no delay looks at."""
        seen = {s.name for value in model.inlined(d.value for d in model.delays) for s in value.free_symbols}
        for name, place in places.items():
            if name not in seen and name in model.state_index:
                message = f"no delay looks at `{name}`, so that its history has no effect"
                help = f"the start of `{name}` is set with `initial {name} = …`; delete the history, or accept it with "
                self._findings.warning("GB373", message, place, help=f"{help}`allow GB373 {name}`", subject=name)

    def _misplaced(self, model: Model) -> None:
        """Reports delays that a `let` brings to places without a past."""
        delayed = {delay.symbol: delay for delay in model.delays}
        for what, value in _timeless(model):
            for found in sorted(value.free_symbols & delayed.keys(), key=str):
                help = "delays stand in balances, rates, `let`, functions and `observe`"
                self._findings.error("GB369", f"{what} cannot hold a delay", delayed[found].span, help=help)


def _timeless(model: Model) -> Iterator[tuple[str, Expr]]:
    """Expressions of other places, intermediates written out, each with its description."""
    for state in model.states:
        for word, value in (("start", state.initial.value), ("history", state.history)):
            if value is not None:
                yield f"the {word} of `{state.name}`", value
    for dose in model.doses:
        yield f"a dose into `{dose.state}`", dose.fraction
        yield f"a dose into `{dose.state}`", dose.lag
    for claim in model.claims:
        for value in model.inlined((claim.value, claim.rate)):
            yield f"the claim `{claim.name}`", value


def _refuse_together(model: Model, checked: Checked, findings: Findings) -> None:
    """Errors for what is not offered together with delays (GB372)."""
    found: list[tuple[str, Span | None]] = []
    found += [(f"the diffusion of `{d.state}`", d.span) for d in model.diffusions]
    found += [(f"the event `{e.name}`", e.span) for e in model.events]
    found += [(f"`{k.name}`, distributed between trajectories,", k.span) for k in model.distributed]
    noises = (c for c in model.channels if c.noise is not None and c.noise.value is not None)
    found += [(f"the learned noise of `{c.name}`", c.span) for c in noises]
    states = {s.declarator.name.text: s.declarator.name.span for s in _arrays(checked)}
    found += [(f"the array `{name}`", place) for name, place in states.items()]
    for what, place in found:
        message = f"{what} and delays are not offered in one model yet"
        help = "leave one of them out; a chain of states `a' = (x - a)*n/tau` approximates a delay"
        findings.error("GB372", message, place, help=help)


def _arrays(checked: Checked) -> Iterator[ast.StateStatement]:
    for item in checked.source or checked.items:
        if isinstance(item.statement, ast.StateStatement) and item.statement.declarator.first is not None:
            yield item.statement
