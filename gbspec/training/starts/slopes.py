"""Points of the splines at which balances are compared with slopes, with the networks' arguments and outputs there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import sympy
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule, Network, Networks
from gbspec.data import Signal, Trajectories, evaluate
from gbspec.ir import Model, unknowns_in_equations, used_by_balances
from gbspec.training.engines import torch_arithmetic
from gbspec.training.problem import Integers
from gbspec.training.starts.past import Past
from gbspec.training.starts.splines import Curves

POINTS = 6000
"""Approximate upper limit on the number of points, for any amount of data."""
LEAST = 400
"""A trajectory has four points per row up to this number of points, and otherwise as many points as rows."""


@dataclass(frozen=True)
class Points:
    """M points of the curves: `t` [M], `x` and `slope` [M, n_states], `condition`, `inputs`, `trajectory` [M].

    `equations`: indices of the balances that can be compared: their states, and all states that they contain, have
    curves. `rough`: balances whose own state has a curve, with unmeasured states at a guess, which suffices for orders
    of magnitude. `scale` [n_states]: size of the slopes; `measurements`: number of values that the curves are fitted
    to; `past`: what delays look at, in models with delays.
    """

    t: Array
    x: Array
    slope: Array
    condition: Array
    inputs: Array
    trajectory: Integers
    equations: tuple[int, ...]
    rough: tuple[int, ...]
    scale: Array
    measurements: int
    past: Past | None = None
    solved: Array | None = None
    """The states [M, n_states] for arguments of unknown functions, where more is known of them than `x` has."""

    def __len__(self) -> int:
        return len(self.t)

    def some(self, index: Integers) -> Points:
        """Some of the points."""
        columns = ("t", "x", "slope", "condition", "inputs", "trajectory")
        solved = None if self.solved is None else self.solved[index]
        return replace(self, solved=solved, **{name: getattr(self, name)[index] for name in columns})


def comparable_balances(model: Model, curves: Curves) -> tuple[int, ...]:
    """Balances in which every state, including that on the left side, has curves."""
    hidden = {s.symbol for i, s in enumerate(model.states) if not curves.covers(i)}
    if unknowns_in_equations(model):  # their values cannot be free numbers while equations are solved
        return ()
    used = used_by_balances(model)
    return tuple(
        i
        for i, s in enumerate(model.states)
        if s.symbol not in hidden and not (_with_delayed(model, set(used[i])) & hidden)
    )


def _with_delayed(model: Model, symbols: set[sympy.Symbol]) -> set[sympy.Symbol]:
    """The symbols, with those in the delayed quantities among them."""
    delayed = [delay.value for delay in model.delays if delay.symbol in symbols]
    return symbols.union(*(value.free_symbols for value in model.inlined(delayed)))


def collocate(model: Model, trajectories: Trajectories, curves: Curves, guess: Array) -> Points:
    """Evenly spaced points within the common span of the curves of a trajectory's required states.

    States without curves have the values `guess` [N, n_states]. Where no state has one, the points span trajectories.
    """
    equations = comparable_balances(model, curves)
    covered = [i for i in range(len(model.states)) if curves.covers(i)]
    share = max(POINTS // max(len(trajectories), 1), 4)
    columns: dict[str, list[Array]] = {name: [] for name in ("t", "x", "slope", "condition", "inputs", "trajectory")}
    for i, item in enumerate(trajectories.items):
        found = [curves.items[i][state] for state in covered]
        present = [curve for curve in found if curve is not None]
        if len(present) < len(found):
            continue
        # Without any curve there are still the points of the conditions and inputs.
        low = max((c.low for c in present), default=item.start)
        high = min((c.high for c in present), default=item.end)
        if high <= low:
            continue
        count = min(share, max(min(4 * len(item.times), LEAST), len(item.times)))
        t = low + (high - low) * (np.arange(count) + 0.5) / count
        t = t[~((curves.gaps[i][:, :1] < t) & (t < curves.gaps[i][:, 1:])).any(axis=0)]
        count = len(t)
        x, slope = np.tile(guess[i], (count, 1)), np.zeros((count, len(model.states)))
        for state, curve in zip(covered, present, strict=True):
            x[:, state], slope[:, state] = curve.value(t), curve.slope(t)
        columns["t"].append(t)
        columns["x"].append(x)
        columns["slope"].append(slope)
        columns["condition"].append(np.tile(item.condition, (count, 1)))
        columns["inputs"].append(inputs_at(model, item.inputs, t))
        columns["trajectory"].append(np.full(count, float(i)))
    n = len(model.states)
    empty = {"t": (0,), "x": (0, n), "slope": (0, n), "condition": (0, len(model.conditions))}
    empty |= {"inputs": (0, len(model.inputs)), "trajectory": (0,)}
    joined = {name: np.concatenate([*parts, np.zeros(empty[name])]) for name, parts in columns.items()}
    slope = joined["slope"]
    scale = np.sqrt((slope**2).mean(axis=0)) if len(slope) else np.ones(n)
    return Points(
        joined["t"],
        joined["x"],
        slope,
        joined["condition"],
        joined["inputs"],
        joined["trajectory"].astype(np.int64),
        equations if len(slope) else (),
        tuple(covered) if len(slope) else (),
        np.where(scale > 0, scale, 1.0),
        max(trajectories.measurements, 1),
        Past(model, trajectories, curves, guess) if model.delays else None,
    )


def inputs_at(model: Model, signals: Sequence[Signal], t: Array) -> Array:
    """The inputs of a trajectory [M, n_inputs] at times [M]."""
    out = np.zeros((len(t), len(model.inputs)))
    for j, (spec, signal) in enumerate(zip(model.inputs, signals, strict=True)):
        out[:, j] = evaluate(signal, spec.interpolation, t)
    return out


class FreeOutputs:
    """Networks whose outputs are free numbers at each point, one for each application; records their arguments.

    They replace the module's networks: `values` [M, Q] are the outputs in the order in which a right-hand side uses
    them, `arguments` the recorded arguments, one (network, [M, E, n_arguments]) per application; E is 1, or the number
    of elements where a network is applied to whole arrays.
    """

    def __init__(self, model: Model, count: int) -> None:
        self.model, self.count = model, count
        self.values: Tensor | None = None
        self.neutral: list[float] = []
        self.arguments: list[tuple[int, Array]] = []
        self._position = 0

    def functions(self) -> Networks:
        """The functions to pass to `rhs` in place of networks."""
        self._position = 0
        self.arguments = []
        return tuple(self._function(index) for index in range(len(self.model.networks)))

    def _function(self, index: int) -> Network:
        outputs = self.model.networks[index].outputs
        neutral = {u.output: u.neutral for u in self.model.unknowns if u.network == index}

        def apply(*arguments: Tensor) -> tuple[Tensor, ...]:
            tensors = [torch.as_tensor(a, dtype=torch.float64).detach() for a in arguments]
            points = (self.count, 1) if any(a.ndim > 1 for a in tensors) else (self.count,)
            shape = np.broadcast_shapes(points, *(a.shape for a in tensors))
            table = torch.stack([a.expand(shape) for a in tensors], -1).reshape(self.count, -1, len(tensors))
            self.arguments.append((index, table.numpy()))
            begin, each = self._position, table.shape[1]
            self._position += len(outputs) * each
            if self.values is None:
                self.neutral.extend(neutral.get(i, 0.0) for i in range(len(outputs)) for _ in range(each))
                return tuple(torch.full(shape, neutral.get(i, 0.0), dtype=torch.float64) for i in range(len(outputs)))
            columns = self.values[:, begin : self._position].reshape(self.count, len(outputs), each)
            return tuple(columns[:, i].reshape(shape) for i in range(len(outputs)))

        return apply


def evaluate_rhs(
    model: Model, module: GeneratedModule, points: Points, constants: Tensor, networks: Networks
) -> Tensor:
    """Right-hand sides [M, n_states] at the points, with constants [M, n_constants]."""
    out: Tensor = module.equations.rhs(torch_arithmetic(module), *_places(module, points, constants, networks))
    return out


def evaluate_elsewhere(
    model: Model, module: GeneratedModule, points: Points, constants: Tensor, networks: Networks
) -> None:
    """Evaluates channels, and conditions, priorities and resets of events, as `evaluate_rhs` does balances, for the
    arguments of the networks in them."""
    equations = module.equations
    used = [equations.observe, *([equations.guards, equations.happen] if model.events else [])]
    if any(event.rank is not None for event in model.events):
        used.append(equations.ranks)
    places = _places(module, points, constants, networks)
    for method in used:
        method(torch_arithmetic(module), *places)


def _places(
    module: GeneratedModule, points: Points, constants: Tensor, networks: Networks
) -> tuple[Tensor, Tensor, Tensor, Tensor, tuple[Tensor, ...], Networks]:
    """What equations are evaluated at: times, states, conditions, inputs (with delayed values), constants, networks."""
    k = tuple(constants[:, i] for i in range(constants.shape[1]))
    t, x = torch.from_numpy(points.t), torch.from_numpy(points.x)
    c, u = torch.from_numpy(points.condition), torch.from_numpy(points.inputs)
    if points.past is not None:
        u = torch.cat([u, points.past.late(module, t, points.trajectory, c, k, networks)], 1)
    return t, x, c, u, k, networks
