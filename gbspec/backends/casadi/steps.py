"""The module's own integration steps over a trajectory, in one call of casadi's mapaccum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.backends.casadi.timeline import Segment
from gbspec.backends.protocol import Casadi, GeneratedModule
from gbspec.ir import METHODS, RK4, Method


@dataclass(frozen=True)
class StepPlan:
    """Steps in order: times and sizes [n], inputs at the method's nodes [nodes, n, n_inputs], what is added to the
    state before each step [n, n_states]; `after` [n_times] is the number of steps before each output."""

    times: Array
    sizes: Array
    inputs: Array
    jumps: Array
    after: NDArray[np.int64]


def plan(
    begin: float,
    outputs: Array,
    pieces: Sequence[Segment],
    max_step: float,
    n_states: int,
    n_inputs: int,
    method: Method = RK4,
    parts: int = 1,
) -> StepPlan:
    """Steps of a method, equal and at most `max_step` long between consecutive outputs and ends of segments.

    With `parts`, each of these steps is divided into as many: where inputs change often, a smaller `max_step` alone may
    change nothing.
    """
    if not max_step > 0:
        raise ValueError(f"max_step must be positive, not {max_step}")
    times: list[float] = []
    sizes: list[float] = []
    inputs: list[Array] = []
    jumps: list[Array] = []
    after = {begin: 0}
    nodes = np.array(method.nodes, dtype=np.float64)
    for piece in pieces:
        inside = outputs[(outputs > piece.begin) & (outputs < piece.end)]
        bounds = [piece.begin, *map(float, inside), piece.end]
        jump = piece.jump
        for a, b in pairwise(bounds):
            count = parts * max(1, ceil((b - a) / max_step - 1e-9))
            first = a + (piece.insets[0] if a == piece.begin else 0.0)
            h = (b - (piece.insets[1] if b == piece.end else 0.0) - first) / count
            for j in range(count):
                t = first + j * h
                times.append(t)
                sizes.append(h)
                elapsed = (t + nodes * h - piece.begin)[:, None]
                inputs.append(piece.inputs + piece.slopes * elapsed)
                jumps.append(jump)
                jump = np.zeros(n_states)
            after[b] = len(times)
    return StepPlan(
        np.array(times),
        np.array(sizes),
        np.array(inputs).reshape(len(times), len(nodes), n_inputs).swapaxes(0, 1),
        np.array(jumps).reshape(len(times), n_states),
        np.array([after[float(time)] for time in outputs], dtype=np.int64),
    )


LONGEST = 256
"""The most steps of one accumulated function: the time to build it grows with them."""


class Stepper:
    """Runs plans, by one accumulated function per power of two of steps; plans are padded with steps of size 0."""

    def __init__(self, instance: GeneratedModule) -> None:
        self._step = _step_function(instance)
        self._accumulated: dict[int, Casadi] = {}

    def run(self, x0: Array, plan: StepPlan, condition: Array, constants: Array) -> Array:
        """States [n_times, n_states] at the plan's outputs."""
        n = len(plan.times)
        path = np.empty((n + 1, len(x0)))
        path[0] = x0
        columns = [plan.times[None], plan.sizes[None], *(u.T for u in plan.inputs), plan.jumps.T]
        for first in range(0, n, LONGEST):
            count = min(LONGEST, n - first)
            part = [block[:, first : first + count] for block in columns]
            path[first + 1 : first + count + 1] = self._run(path[first], part, condition, constants)
        return path[plan.after]

    def _run(self, x0: Array, columns: Sequence[Array], condition: Array, constants: Array) -> Array:
        """States [n, n_states] after each of n steps, which are columns of times, sizes, inputs and jumps."""
        n = columns[0].shape[1]
        length = 1 << (n - 1).bit_length()
        if length not in self._accumulated:
            self._accumulated[length] = self._step.mapaccum(length)
        padded = [np.pad(block, ((0, 0), (0, length - n)), mode="edge") for block in columns]
        padded[1][:, n:] = 0.0
        constant = [np.repeat(v[:, None], length, axis=1) for v in (condition, constants)]
        return np.asarray(np.array(self._accumulated[length](x0, *padded, *constant)).T[:n], dtype=np.float64)


def _step_function(instance: GeneratedModule) -> Casadi:
    """casadi.Function (x, t, h, u0, u1, ..., jump, condition, constants) -> x one step later; inputs at the nodes."""
    kind: Casadi = ca.MX if instance.networks or hasattr(instance.equations, "blocks") else ca.SX
    n_states = len(instance.states)
    sizes = {
        "x": n_states,
        "t": 1,
        "h": 1,
        **dict.fromkeys(METHODS[instance.solver].input_names, len(instance.inputs)),
        "jump": n_states,
    }
    sizes |= {"condition": len(instance.conditions), "constants": len(instance.constants)}
    arguments = {name: kind.sym(name, size) for name, size in sizes.items()}
    x, t, h, *inputs, jump, condition, constants = arguments.values()
    m = instance.arithmetic("casadi")
    rhs = instance.equations.field(m, condition, m.unpack(constants), instance.casadi_networks())
    after = instance.equations.step(m, rhs, instance.equations.grid(m, t, h), x + jump, tuple(inputs))
    return ca.Function("step", [*arguments.values()], [ca.densify(after)], [*arguments], ["after"])
