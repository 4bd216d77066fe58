"""Decides whether right-hand sides are affine in states, inputs and outputs of networks.

If they are, and all trajectories share the factors, an engine may evaluate them as products of matrices that are
computed once per solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir.forms import described
from gbspec.ir.model import NN, Expr, Model, Unknown


class _Kind(IntEnum):
    """The class of an expression, from the narrowest to the widest."""

    SHARED = 0
    """A number shared by all trajectories and times."""
    OWN = 1
    """A number that may differ between trajectories."""
    MOVING = 2
    """Affine in states and inputs, with shared factors."""
    OUTPUT = 3
    """Affine also in outputs of networks."""


class _NotAffineError(Exception):
    """An expression is in none of these classes."""


def is_affine(model: Model) -> bool:
    """Whether all balances are affine in states, inputs and calls of networks, whose arguments are affine in states and
    inputs, every factor being shared by all trajectories. Arrays of states, and networks without a hidden layer, do not
    count."""
    if model.arrays or model.algebraics or any(not network.hidden for network in model.networks):
        return False
    try:
        reader = _Reader(model)
        for balance in model.inlined(model.balances):
            reader.kind(balance, reader.symbols)
    except _NotAffineError:
        return False
    return True


class _Reader:
    def __init__(self, model: Model) -> None:
        self.model = model
        self.unknowns = {unknown.name: unknown for unknown in model.unknowns}
        self.symbols: dict[sympy.Symbol, _Kind] = {item.symbol: _Kind.SHARED for item in model.constants}
        self.symbols |= {k.symbol: _Kind.OWN if k.per_trajectory else _Kind.SHARED for k in model.learnables}
        self.symbols |= {item.symbol: _Kind.OWN for item in model.conditions}
        self.symbols |= {item.symbol: _Kind.MOVING for item in (*model.states, *model.inputs)}

    def kind(self, node: Expr, symbols: Mapping[sympy.Symbol, _Kind]) -> _Kind:
        """The class of an expression. Raises _NotAffineError if it is in none."""
        if isinstance(node, sympy.Symbol):
            if node not in symbols:  # the time
                raise _NotAffineError
            return symbols[node]
        if isinstance(node, AppliedUndef):
            return self._applied(self.unknowns[node.func.__name__], [self.kind(a, symbols) for a in node.args])
        kinds = [self.kind(argument, symbols) for argument in node.args]
        largest = max(kinds, default=_Kind.SHARED)
        if largest <= _Kind.OWN or isinstance(node, sympy.Add):
            return largest
        if isinstance(node, sympy.Mul) and sorted(kinds)[:-1] == [_Kind.SHARED] * (len(kinds) - 1):
            return largest
        raise _NotAffineError

    def _applied(self, unknown: Unknown, arguments: list[_Kind]) -> _Kind:
        """The value of an unknown: its postulate, or the form of its contracts, with arguments of these classes."""
        if _Kind.OUTPUT in arguments:
            raise _NotAffineError
        formals = self.model.networks[unknown.network].arguments
        inside = self.symbols | {a.symbol: kind for a, kind in zip(formals, arguments, strict=True)}
        if unknown.form is None:
            return self.kind(unknown.postulate, inside | {NN: _Kind.OUTPUT})
        value = unknown.form.value
        found = {s: described(s.name) for s in value.free_symbols}
        kept = {s: _Kind.OUTPUT if word[0] == "raw" else _Kind.SHARED for s, word in found.items() if word is not None}
        if any(self.kind(node, inside) == _Kind.OUTPUT for point in unknown.form.evaluations for node in point):
            raise _NotAffineError
        return self.kind(value, inside | kept)
