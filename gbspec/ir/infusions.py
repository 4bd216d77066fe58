"""Infusions: doses that last, which are inputs of the model and terms of its balances."""

from __future__ import annotations

import sympy

from gbspec.ir.model import Expr, Model


def uninfused(model: Model) -> tuple[Expr, ...]:
    """The balances without infusions, which like other doses are no part of what a model claims."""
    nothing = {signal.symbol: sympy.S.Zero for signal in model.inputs if signal.infuses}
    return tuple(balance.xreplace(nothing) for balance in model.balances) if nothing else model.balances
