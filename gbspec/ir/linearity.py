"""Which models are linear in their states, so that mean and covariance between measurements are known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir.model import Expr, Model

MOST_STATES = 40
"""Larger models are not examined."""


@dataclass(frozen=True)
class Linear:
    """A model whose balances are linear in its states, with factors that are constant within a sub-step.

    `inputs` are the positions of the (held) inputs that the factors and the disturbances depend on. `steady`: what does
    not depend on the states is constant within a sub-step too. `observed`: the channels are linear in the states.
    """

    inputs: tuple[int, ...]
    steady: bool
    observed: bool


def linear_in_states(model: Model) -> Linear | None:
    """The linearity of a model; None if it is not linear, or a factor or a disturbance varies within a sub-step."""
    if len(model.states) > MOST_STATES or any(d.relative is not None for d in model.diffusions):
        return None
    states = [state.symbol for state in model.states]
    balances = model.inlined(model.balances)
    factors: list[Expr] = [diffusion.value for diffusion in model.diffusions]
    if any(set(states) & factor.free_symbols for factor in factors):
        return None
    for balance in balances:
        found = _factors(balance, states)
        if found is None:
            return None
        factors += found
    used = {symbol for factor in factors for symbol in factor.free_symbols}
    moving = {model.time.symbol} | {u.symbol for u in model.inputs if u.interpolation != "held"}
    if used & moving:
        return None
    steady = not any(moving & balance.free_symbols for balance in balances)
    channels = model.inlined([channel.value for channel in model.channels])
    observed = all(_factors(value, states) is not None for value in channels)
    return Linear(tuple(i for i, u in enumerate(model.inputs) if u.symbol in used), steady, observed)


def _factors(balance: Expr, states: list[sympy.Symbol]) -> list[Expr] | None:
    """The factors of the states in a balance; None if it is not linear in them."""
    occurring = [state for state in states if state in balance.free_symbols]
    if any(set(occurring) & a.free_symbols for a in balance.atoms(AppliedUndef)):
        return None
    found = [sympy.diff(balance, state) for state in occurring]
    if any(set(states) & factor.free_symbols or factor.has(sympy.Derivative) for factor in map(sympy.expand, found)):
        return None
    return found
