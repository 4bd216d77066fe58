"""Arrivals: events of a trajectory between two sub-steps of the solver.

A measurement (which may reset states), a change of an input and a dose are arrivals: each has a time, and no sub-step
of the solver crosses one. Simultaneous arrivals are processed in this order: measurement, change of an input, dose.

Times that follow from the data alone are boundaries of sub-steps when the data are packed (`boundaries`). The time of
a dose whose lag is learned changes during the fit; `path` cuts the sub-steps into which such doses fall, for a given
vector.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import Trajectories, Trajectory
from gbspec.ir import Dose, Expr, Model, scheduled, switching_times
from gbspec.training.problem.delays import echoes, jumps, looked_back

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class DoseTable:
    """All doses of a batch [E]: the trajectory, the index among the model's doses, the time given, and the amount.

    `known`: for each of the model's doses, whether its lag does not depend on learned quantities, so that a sub-step
    begins at its arrival.
    """

    owner: Integers
    kind: Integers
    time: Array
    amount: Array
    known: tuple[bool, ...]

    def take(self, indices: Integers) -> DoseTable:
        """The doses of some of the trajectories, in the order given (repeats allowed)."""
        found = [np.flatnonzero(self.owner == i) for i in indices]
        rows = np.concatenate([np.zeros(0, dtype=np.int64), *found])
        owner = np.repeat(np.arange(len(indices)), [len(each) for each in found])
        return DoseTable(owner.astype(np.int64), self.kind[rows], self.time[rows], self.amount[rows], self.known)


Lags = list[float | None]


def known_lags(trajectories: Trajectories, model: Model) -> list[Lags]:
    """The lags of each trajectory's doses."""
    constants = {constant.symbol: constant.value for constant in model.constants}
    terms = [dose.lag.subs(constants) if _known(dose, model) else None for dose in model.doses]
    return [_lags(item, model, terms) for item in trajectories.items]


def _lags(item: Trajectory, model: Model, terms: Sequence[Expr | None]) -> Lags:
    """The lags of a trajectory's doses from their terms over the conditions; None if they are learned.

    A lag that is undefined under the conditions is NaN: such a dose never arrives.
    """
    given = {each.symbol: float(value) for each, value in zip(model.conditions, item.condition, strict=True)}
    found = [term if term is None or term.is_number else term.subs(given) for term in terms]
    return [term if term is None else float(term) if term.is_real and term.is_finite else np.nan for term in found]


def _known(dose: Dose, model: Model) -> bool:
    """Whether the lag of a dose does not depend on learned quantities."""
    return not dose.lag.free_symbols & {learnable.symbol for learnable in model.learnables}


def dose_table(trajectories: Trajectories, model: Model) -> DoseTable:
    """The doses of all trajectories."""
    rows = [
        (i, kind, time, amount)
        for i, item in enumerate(trajectories.items)
        for kind, events in enumerate(item.doses)
        for time, amount in zip(events.times, events.amounts, strict=True)
    ]
    known = [_known(dose, model) for dose in model.doses]
    if model.delays:  # steps begin where jumps show again: arrivals of nothing, after the kinds of doses
        kinds = list(enumerate(echoes(model), len(model.doses)))
        known += [False] * len(kinds)
        switches = switches_of(model)
        rows += [
            (i, kind, time, 0.0)
            for i, item in enumerate(trajectories.items)
            for times in [switches(item, looked_back(item, model))]
            for kind, echo in kinds
            for time in jumps(item, model, echo, times)
        ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return DoseTable(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2], table[:, 3], tuple(known))


def boundaries(item: Trajectory, keys: Array, lags: Lags) -> Array:
    """The prescribed boundaries of a trajectory's sub-steps: its start, its key rows `keys`, and the arrivals between
    them whose times are known."""
    times = [signal.times for signal in item.inputs]
    times += [doses.times + lag for doses, lag in zip(item.doses, lags, strict=True) if lag is not None]
    inside = [s[(s > item.start) & (s < item.end)] for s in times]
    # An arrival within rounding of a key row is moved to that row: no step may be as short as a rounding error.
    distinct = _distinct(np.concatenate([keys, *inside]), keys, item)
    return np.concatenate([[item.start], distinct[distinct > item.start]])


def tolerance_of(item: Trajectory) -> float:
    """Times of a trajectory that differ by no more are one."""
    return 1e-9 * max(item.end - item.start, abs(item.end), 1e-300)


def switches_of(model: Model) -> Callable[[Trajectory, float], Array]:
    """The times in a trajectory, and some time before its start, at which right sides jump, as far as they follow from
    the time and known constants."""
    if not scheduled(model):
        return lambda item, before: np.zeros(0)
    module = load_module(model).random(0)
    fixed = {constant.name: constant.value for constant in model.constants}
    constants = tuple(np.float64(fixed.get(name, np.nan)) for name in module.constants)
    equations, m = module.equations, module.arithmetic("numpy")

    def switches(item: Trajectory, before: float) -> Array:
        def values(t: Array) -> Sequence[Array]:
            found: Sequence[Array] = equations.schedule(m, t, np.asarray(item.condition, dtype=np.float64), constants)
            return found

        return switching_times(values, equations.whole, item.start - before, item.end)

    return switches


def _distinct(times: Array, keys: Array, item: Trajectory) -> Array:
    """Sorted distinct times; one that is not a key and lies within rounding of another is dropped."""
    tolerance = tolerance_of(item)
    ordered = np.unique(times)
    is_key = np.isin(ordered, keys)
    near = np.zeros(len(ordered), dtype=bool)
    if len(keys):
        position = (
            np.clip(np.searchsorted(keys, ordered), 1, len(keys) - 1) if len(keys) > 1 else np.zeros(len(ordered), int)
        )
        distance = np.minimum(np.abs(ordered - keys[position]), np.abs(ordered - keys[np.maximum(position - 1, 0)]))
        near = ~is_key & (distance <= tolerance)
    return np.asarray(ordered[~near], dtype=np.float64)
