"""Steady starts: the states, the values from which their steady state is reached, and what is held meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import sympy

from gbspec.diagnostics import Findings, Label
from gbspec.ir import Expr, Initial, Model, State, Steady
from gbspec.semantics import Checked, suggestion
from gbspec.syntax import ast, target_name

Lower = Callable[[ast.Expression], Expr]


def lowered(model: Model, checked: Checked, fixed: Lower, findings: Findings) -> Model:
    """The model with its steady start, if it has one; doses are off while the steady state is sought."""
    every = list(checked.all(ast.SteadyStatement))
    whole = every[0] if every else None
    for other in every[1:]:
        labels = [Label(every[0].span, "the first")]
        findings.error("GB202", "the steady start is given twice", other.span, labels=labels, help="delete one of them")
    chosen = [i for i, s in enumerate(model.states) if not s.discrete and (whole or s.initial.kind == "steady")]
    if not chosen:
        return model
    states = list(model.states)
    for i in chosen:
        states[i] = _begun(states[i], whole, findings)
    held = () if whole is None else _held(model, whole, fixed, findings)
    held += tuple((item.name, sympy.S.Zero) for item in model.inputs if item.infuses)
    span = whole.span if whole is not None else model.states[chosen[0]].initial.span
    _independent(states, chosen, findings)
    after, sought = ((), None) if whole is None else (_after(model, whole, fixed, findings), _chosen(whole, fixed))
    return replace(model, states=tuple(states), steady=Steady(tuple(chosen), held, (), after, sought, span))


def _begun(state: State, whole: ast.SteadyStatement | None, findings: Findings) -> State:
    """The state with the value from which its steady state is reached."""
    start, value = state.initial, state.initial.value
    place = start.span if whole is None else whole.span
    if start.kind == "learned":
        findings.error(
            "GB375",
            f"`{state.name}` cannot start in a steady state and at a learned value",
            start.span,
            labels=[] if whole is None else [Label(whole.span, "the steady start")],
            help="delete one of them; a total is learned by `learn total` and `initial X = total`",
            subject=state.name,
        )
    if value is None and state.start is not None:
        value = sympy.Float(state.start)
    elif value is None and state.range is not None and state.range.bounded:
        value = sympy.Float((state.range.low + state.range.high) / 2)
    elif value is None:
        findings.error(
            "GB374",
            f"`{state.name}` has no start from which its steady state could be reached",
            state.span,
            labels=[Label(place, "the steady start")] if place is not None else [],
            help=f"write `state {state.name} = 1`, or `initial {state.name} = …`: a conserved total comes from it",
            subject=state.name,
        )
        value = sympy.S.Zero
    return replace(state, initial=Initial("steady", value, start.span))


def _held(model: Model, whole: ast.SteadyStatement, fixed: Lower, findings: Findings) -> tuple[tuple[str, Expr], ...]:
    known = [item.name for item in (*model.inputs, *model.conditions)]
    found: dict[str, Expr] = {}
    for one in whole.held:
        name = target_name(one.target)
        if name.text not in known or isinstance(one.target, ast.Index):
            findings.error(
                "GB377",
                f"`{name.text}` is neither an input nor a condition, so that no value of it can be held",
                name.span,
                help=suggestion(name.text, known) or "write `with L = 0` for an input or a condition `L`",
                subject=name.text,
            )
        elif name.text in found:
            findings.error("GB377", f"`{name.text}` is held at two values", name.span, help="delete one of them")
        else:
            found[name.text] = fixed(one.value)
    return tuple(found.items())


def _after(model: Model, whole: ast.SteadyStatement, fixed: Lower, findings: Findings) -> tuple[tuple[int, Expr], ...]:
    """What states are set to after the steady state was found; right sides see the values before."""
    names = [state.name for state in model.states]
    found: dict[int, Expr] = {}
    for one in whole.after:
        name = target_name(one.target)
        if name.text not in names or isinstance(one.target, ast.Index):
            findings.error(
                "GB815",
                f"`{name.text}` is no state, so that nothing sets it after the steady state",
                name.span,
                help=suggestion(name.text, names) or "write `then X = 1` for a state `X`",
                subject=name.text,
            )
        elif names.index(name.text) in found:
            findings.error("GB815", f"`{name.text}` is set twice", name.span, help="delete one of them")
        else:
            found[names.index(name.text)] = fixed(one.value)
    return tuple(found.items())


def _chosen(whole: ast.SteadyStatement, fixed: Lower) -> Expr | None:
    """1 where the condition of the statement holds, else 0."""
    if whole.condition is None:
        return None
    return sympy.Piecewise((1, fixed(whole.condition)), (0, True))


def _independent(states: list[State], chosen: list[int], findings: Findings) -> None:
    """Reports a start that depends on a state whose own start is sought."""
    steady = {states[i].symbol: states[i].name for i in chosen}
    for i, state in enumerate(states):
        used = set() if state.initial.value is None else state.initial.value.free_symbols & steady.keys()
        if i in chosen or not used:
            continue
        name = min(steady[s] for s in used)
        findings.error(
            "GB378",
            f"the initial value of `{state.name}` depends on `{name}`, whose steady state is sought with"
            f" `{state.name}` fixed",
            state.initial.span,
            help=f"give `{state.name}` a start of its own, or write `initial {state.name} steady` too",
            subject=state.name,
        )
