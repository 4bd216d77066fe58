"""Steady starts: what the equations conserve meanwhile, and what is not offered together with them."""

from __future__ import annotations

from dataclasses import replace

import sympy

from gbspec.diagnostics import Findings, Span
from gbspec.ir import Event, Model, symbol
from gbspec.passes.conservation import linear_laws


def with_steady_start(model: Model, findings: Findings) -> Model:
    """The model with the linear laws of its steady start; records errors (GB375, GB376) for what is not offered."""
    start = model.steady
    if start is None:
        return model
    _refuse_together(model, start.span, findings)
    states = tuple(model.states[i] for i in start.states)
    held = {symbol(name): value for name, value in start.held}
    balances = tuple(b.xreplace(held) for b in model.inlined(model.balances[i] for i in start.states))
    for state, balance in zip(states, balances, strict=True):
        if model.time.symbol in balance.free_symbols:
            findings.error(
                "GB376",
                f"`{state.name}` has no steady state: its balance depends on the time `{model.time.name}`",
                start.span,
                help=f"make what depends on `{model.time.name}` an input, or start `{state.name}` at a value",
                subject=state.name,
            )
            return model
    # Other states are fixed meanwhile; what is held at 0 may conserve more than the whole model does.
    alone = replace(
        model, states=states, balances=balances, intermediates=(), families=(), arrays=(), doses=(), steady=None
    )
    laws = tuple(
        tuple(dict(law.coefficients).get(state.name, sympy.S.Zero) for state in states) for law in linear_laws(alone)
    )
    return replace(model, steady=replace(start, laws=laws))


def _refuse_together(model: Model, place: Span | None, findings: Findings) -> None:
    watched = [event for event in model.events if event.guard is not None]
    alone = () if model.steady is None else model.steady.states
    one_each = "leave out `~ …`, so that each trajectory has a value of its own"
    stated = "state noises by numbers, or leave them out (they are then estimated)"
    reasons = [
        (bool(model.diffusions), "random disturbances (`diffusion`)", "leave one of them out"),
        (
            model.marginal,
            "constants that are distributed between trajectories, or learned noises",
            f"{one_each if model.distributed else stated}, or give the starts as expressions",
        ),
        (bool(model.algebraics), "algebraic variables", "give the starts as expressions"),
        (bool(model.delays), "delays", "give the starts as expressions, and the past by `history`"),
        (
            any(event.armed for event in watched),
            "events that count at the start of a trajectory (`armed`)",
            "leave out `armed`: conditions that are true at rest do not become true at the start",
        ),
        (
            bool(watched) and set(alone) != {i for i, state in enumerate(model.states) if not state.discrete},
            "events with a condition (`when`) where only some states start so",
            "write `initial steady`, for all of them",
        ),
        (
            any(_timed(model, event) for event in watched),
            "events whose condition (`when`) depends on the time, or that happen `after` a delay",
            "write `event … at`, which counts from the start of a trajectory",
        ),
    ]
    for there, what, help in reasons:
        if there:
            findings.error("GB375", f"a steady start is not offered together with {what}", place, help=help)


def _timed(model: Model, event: Event) -> bool:
    """Whether the time matters to an event with a condition, which may happen on the way to the steady state."""
    values = model.inlined([*([] if event.guard is None else [event.guard]), *(value for _, value in event.values)])
    return any(model.time.symbol in value.free_symbols for value in values)
