"""Steady starts: what the equations conserve meanwhile, and what is not offered together with them."""

from __future__ import annotations

from dataclasses import replace

import sympy

from gbspec.diagnostics import Findings, Span
from gbspec.ir import Model, symbol
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
    reasons = [
        (bool(model.diffusions), "random disturbances (`diffusion`)", "leave one of them out"),
        (
            model.marginal,
            "constants that are distributed between trajectories, or learned noises",
            "leave out `~ …`, so that each trajectory has a value of its own, or give the starts as expressions",
        ),
        (bool(model.algebraics), "algebraic variables", "give the starts as expressions"),
        (bool(model.delays), "delays", "give the starts as expressions, and the past by `history`"),
        (
            any(event.guard is not None for event in model.events),
            "events with a condition (`when`)",
            "start at values, and let the model run before the first row",
        ),
    ]
    for there, what, help in reasons:
        if there:
            findings.error("GB375", f"a steady start is not offered together with {what}", place, help=help)
