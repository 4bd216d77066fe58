"""States that nothing measures and no range bounds, at the points of the warm start, from solutions of the model.

A temperature that follows a measured one with a delay is known but for its constants: solutions at the declared starts
of these tell the size of the arguments of unknown functions. A guess of zero would not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sympy.core.function import AppliedUndef

from gbspec.arrays import Array, Mask
from gbspec.ir import Model, right_sides, unknowns_in_equations, used_by_balances
from gbspec.training.engines import predicted
from gbspec.training.problem import Parameters
from gbspec.training.recipe.context import Context
from gbspec.training.starts import Points

AGREE = 0.1
"""Solutions at the step and at half of it differ by less than this fraction of their standard deviation."""
SHARE = 0.02
"""So many of the values at either side are taken for those at its end: a state may begin far from where it stays."""


def solved_states(model: Model, covered: Mask) -> Mask:
    """The states [n_states] without a curve (`covered`) and a declared range that arguments of unknown functions
    contain, and whose balances and resets contain no such function, nor another state that neither a curve nor a
    balance shows."""
    hidden = ~covered
    if not model.networks or model.diffusions or unknowns_in_equations(model):
        return np.zeros_like(hidden)
    symbols = [state.symbol for state in model.states]
    set_by = {name for e in model.events for name, value in e.values if model.inlined([value])[0].has(AppliedUndef)}
    balances = zip(model.states, model.inlined(model.balances), strict=True)
    learned = np.array([one.name in set_by or balance.has(AppliedUndef) for one, balance in balances], dtype=np.bool_)
    uses = [np.array([s in used for s in symbols], dtype=np.bool_) for used in used_by_balances(model)]
    known = hidden & ~learned
    while (
        dropped := np.array([k and (used & hidden & ~known).any() for k, used in zip(known, uses, strict=True)])
    ).any():
        known &= ~dropped
    ranged = np.array([s.range is not None and s.range.bounded for s in model.states], dtype=np.bool_)
    applied = {free for side in right_sides(model) for one in side.atoms(AppliedUndef) for free in one.free_symbols}
    return np.asarray(known & ~ranged & [one in applied for one in symbols], dtype=np.bool_)


def with_solved_states(context: Context, natural: Array) -> Points:
    """The points with `solved` states as solutions have them that follow measured states from row to row, at learnable
    constants `natural` [n]; where the step is too large for such a solution, with the guesses that they have."""
    points, model = context.points, context.model
    covered = np.array([context.curves.covers(i) for i in range(len(model.states))], dtype=np.bool_)
    states = np.flatnonzero(solved_states(model, covered))
    if not len(states) or not len(points):
        return points
    scales = {k: value for k, value in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    parameters = context.parameters(scales)
    theta, x = parameters.vector(context.module.weights, natural), points.x.copy()
    coarse, fine = (_at_points(context, parameters, theta, fraction)[:, states] for fraction in (1.0, 0.5))
    for i, state in enumerate(states):
        one = fine[:, i]
        if np.isfinite(one).all() and bool(np.abs(coarse[:, i] - one).max() <= AGREE * one.std()):
            x[:, state] = np.clip(one, *np.quantile(one, [SHARE, 1 - SHARE]))
    return replace(points, solved=x)


def _at_points(context: Context, parameters: Parameters, theta: Array, fraction: float) -> Array:
    """The states [M, n_states] of a solution at the points, at `fraction` of the largest step."""
    points, x = context.points, context.points.x.copy()
    made = context if fraction == 1.0 else context.finer(fraction)
    found, packed = predicted(made.engine(parameters), theta), made.packed()
    for i, item in enumerate(context.trajectories.items):
        rows, mine = packed.row_trajectory == i, points.trajectory == i
        times = np.concatenate([[item.start], packed.row_time[rows]])
        values = np.concatenate([found.initial[[i]], found.before[rows]])
        for state in range(x.shape[1]):
            x[mine, state] = np.interp(points.t[mine], times, values[:, state])
    return x
