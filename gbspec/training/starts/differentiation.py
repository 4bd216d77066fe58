"""Curves of unmeasured states that the balances of measured ones give by differentiation.

If the balance of a state with a curve contains one state without a curve, is linear in it and otherwise known
(`q' = v`), the slope of the curve determines that state. Curves that are differentiated are smoothed (generalised
cross-validation), since differentiation amplifies noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from sympy.core.function import AppliedUndef

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.data import Trajectories, Trajectory
from gbspec.ir import Model, used_by_balances
from gbspec.training.starts.slopes import Points, evaluate_rhs, inputs_at
from gbspec.training.starts.splines import Curves, StateCurve, curve_of, smoothed

MOST = 2500
"""Longer series are averaged over neighbouring values before they are smoothed."""
UNITS = (2.0, 20.0, 200.0)
"""The units of time that are tried, in multiples of the typical spacing."""


def with_derived(model: Model, module: GeneratedModule, trajectories: Trajectories, curves: Curves) -> Curves:
    """The curves, with those of unmeasured states where a balance determines them."""
    found = determined(model, curves)
    while found is not None:
        balance, state = found
        items = []
        for index, item in enumerate(trajectories.items):
            row = list(curves.items[index])
            row[state] = _derived(model, module, item, curves.items[index], balance, state)
            items.append(tuple(row))
        new = replace(curves, items=tuple(items))
        if not new.covers(state):
            return curves
        curves, found = new, determined(model, new)
    return curves


def determined(model: Model, curves: Curves) -> tuple[int, int] | None:
    """A balance and the state without a curve that it determines by the slope of its own state; None if there is
    none."""
    hidden = {s.symbol: i for i, s in enumerate(model.states) if not curves.covers(i)}
    learned = {k.symbol for k in model.learnables}
    used = used_by_balances(model) if hidden and not model.delays else []
    for index, (balance, symbols) in enumerate(zip(model.inlined(model.balances), used, strict=False)):
        contained = symbols & hidden.keys()
        if len(contained) != 1 or not curves.covers(index):
            continue
        (symbol,) = contained
        slope = balance.diff(symbol)
        if not (symbols & learned or balance.atoms(AppliedUndef) or slope.free_symbols or slope == 0):
            return index, hidden[symbol]
    return None


def _derived(
    model: Model,
    module: GeneratedModule,
    item: Trajectory,
    curves: tuple[StateCurve | None, ...],
    balance: int,
    state: int,
) -> StateCurve | None:
    """The curve of `state` of a trajectory; None if the states that the balance needs have no curves there."""
    needed = used_by_balances(model)[balance]
    own = curves[balance]
    others = [curves[i] for i, s in enumerate(model.states) if s.symbol in needed and i != state]
    if own is None or any(curve is None for curve in others):
        return None
    present = [own, *(curve for curve in others if curve is not None)]
    low, high = max(c.low for c in present), min(c.high for c in present)
    times = item.times[(item.times >= low) & (item.times <= high)]
    if len(times) < 2:
        return None
    x = np.zeros((len(times), len(model.states)))
    for i, curve in enumerate(curves):
        if curve is not None and i != state:
            x[:, i] = curve.extended(times)
    slope = slopes(times, own.value(times))
    at_zero, at_one = (_balance(model, module, item, times, _with(x, state, value), balance) for value in (0.0, 1.0))
    return curve_of(times, (slope - at_zero) / (at_one - at_zero))


def slopes(t: Array, y: Array) -> Array:
    """The derivative, at times `t`, of a smooth curve through values `y`.

    The range of penalties depends on the unit of time. Of several units the one is chosen whose spline through every
    second value predicts the others best.
    """
    count = len(t) // MOST + 1
    kept = np.arange(len(t) // count * count).reshape(-1, count)
    times, values = t[kept].mean(axis=1), y[kept].mean(axis=1)
    spacing = float(np.median(np.diff(times))) if len(times) > 1 else 1.0

    def error(unit: float) -> float:
        curve = smoothed(times[::2], values[::2], unit * spacing)
        return float("inf") if curve is None else float(np.mean((curve(times[1:-1:2]) - values[1:-1:2]) ** 2))

    curve = smoothed(times, values, min(UNITS, key=error) * spacing)
    return np.asarray(curve.derivative()(t) if curve is not None else np.gradient(y, t), dtype=np.float64)


def _with(x: Array, state: int, value: float) -> Array:
    out = x.copy()
    out[:, state] = value
    return out


def _balance(model: Model, module: GeneratedModule, item: Trajectory, t: Array, x: Array, balance: int) -> Array:
    """The right-hand side of a balance at points of a trajectory; it contains nothing that is learned."""
    count, n = len(t), len(model.states)
    points = Points(
        t, x, np.zeros((count, n)), np.tile(item.condition, (count, 1)), inputs_at(model, item.inputs, t),
        np.zeros(count, dtype=np.int64), (), (), np.ones(n), count,
    )  # fmt: skip
    start = [constant.value for constant in model.constants] + [k.start for k in model.learnables]
    constants = torch.tensor(start, dtype=torch.float64).expand(count, -1)
    networks = module.torch_networks({k: torch.from_numpy(np.asarray(v)) for k, v in module.weights.items()})
    with torch.no_grad():
        return np.asarray(evaluate_rhs(model, module, points, constants, networks)[:, balance].numpy())
