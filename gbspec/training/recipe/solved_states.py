"""States that nothing measures and no range bounds, at the points of the warm start, from solutions of the model.

A temperature that follows a measured one with a delay is known but for its constants: solutions at the declared starts
of these tell the size of the arguments of unknown functions. A guess of zero would not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sympy.core.function import AppliedUndef

from gbspec.arrays import Array, Mask
from gbspec.ir import Model, unknowns_in_equations, used_by_balances
from gbspec.training.engines import predicted
from gbspec.training.recipe.context import Context
from gbspec.training.starts import Points

SHARE = 0.02
"""So many of the values at either side are taken for those at its end: a state may begin far from where it stays."""


def solved_states(model: Model, covered: Mask) -> Mask:
    """The states [n_states] without a curve (`covered`) and a declared range whose balances contain no unknown
    function, nor any other state that neither a curve nor such a balance shows."""
    hidden = ~covered
    if not model.networks or model.diffusions or unknowns_in_equations(model):
        return np.zeros_like(hidden)
    symbols = [state.symbol for state in model.states]
    learned = np.array([balance.has(AppliedUndef) for balance in model.inlined(model.balances)], dtype=np.bool_)
    uses = [np.array([s in used for s in symbols], dtype=np.bool_) for used in used_by_balances(model)]
    known = hidden & ~learned
    while (
        dropped := np.array([k and (used & hidden & ~known).any() for k, used in zip(known, uses, strict=True)])
    ).any():
        known &= ~dropped
    ranged = np.array([s.range is not None and s.range.bounded for s in model.states], dtype=np.bool_)
    return np.asarray(known & ~ranged, dtype=np.bool_)


def with_solved_states(context: Context, natural: Array) -> Points:
    """The points with these states as solutions have them that follow measured states from row to row, at learnable
    constants `natural` [n]; where such a solution is not finite, with the guesses that they have."""
    points, model = context.points, context.model
    states = solved_states(
        model, np.array([context.curves.covers(i) for i in range(len(model.states))], dtype=np.bool_)
    )
    if not states.any() or not len(points):
        return points
    scales = {k: value for k, value in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    parameters = context.parameters(scales)
    found = predicted(context.engine(parameters), parameters.vector(context.module.weights, natural))
    packed, x = context.packed(), points.x.copy()
    for i, item in enumerate(context.trajectories.items):
        rows, mine = packed.row_trajectory == i, points.trajectory == i
        times = np.concatenate([[item.start], packed.row_time[rows]])
        for state in np.flatnonzero(states):
            values = np.concatenate([found.initial[i, [state]], found.before[rows, state]])
            x[mine, state] = np.interp(points.t[mine], times, values)
    for state in np.flatnonzero(states):
        if np.isfinite(x[:, state]).all():
            x[:, state] = np.clip(x[:, state], *np.quantile(x[:, state], [SHARE, 1 - SHARE]))
        else:
            x[:, state] = points.x[:, state]
    return replace(points, x=x)
