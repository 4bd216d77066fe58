"""Solutions of models with random disturbances, by Strang splitting.

Each sub-step is half a step of the disturbance alone, a Runge-Kutta step of the drift (order 4), and half a step of
the disturbance again. The disturbance alone is solved exactly where its size does not depend on the state (an
increment), or is proportional to it (Ito: a factor exp(sigma W - sigma^2 t / 2)), and of the logit of a state where its
size is proportional to the distances from two numbers: distributions then have the order 2 in the length of the
sub-step (Strang 1968; Ninomiya and Victoir 2008). Other sizes are taken at the state before (Euler and Maruyama, order
1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.ir import coordinates_of

if TYPE_CHECKING:
    from gbspec.analysis.simulation.design import Plan
    from gbspec.backends import GeneratedModule
    from gbspec.ir import Model

PARTS = 20
"""Sub-steps between two measurements, at least."""
LEAST = 400
"""Sub-steps of a trajectory, at least."""


def disturbed_path(
    instance: GeneratedModule, model: Model, plan: Plan, x0: Array, times: Array, random: np.random.Generator
) -> Array:
    """States [T, n] at increasing `times`, from `x0` at the plan's start, with the disturbances that `random` draws.

    Raises ComputationError where the solution is not finite.
    """
    path = _Path(instance, model, plan)
    x, at, out = x0.copy(), plan.start, []
    longest = max(float(times[-1]) - plan.start, 1e-300) / LEAST
    for time in times:
        while at < time:
            end = min([time, *(edge for edge in path.edges if at < edge < time)])
            x = path.dosed(x, at)
            count = max(PARTS if end == time else 1, int(np.ceil((end - at) / longest)))
            h = (end - at) / count
            for k in range(count):
                x = path.step(x, at + k * h, h, random)
            at = end
            if not np.isfinite(x).all():
                raise ComputationError("the disturbed solution is not finite", where=f"trajectory {plan.label}")
        out.append(x)
    return np.array(out)


class _Path:
    """The drift, the disturbances and the doses of a plan."""

    def __init__(self, instance: GeneratedModule, model: Model, plan: Plan) -> None:
        self.equations, self.ops = instance.equations, instance.arithmetic("numpy")
        self.model, self.plan = model, plan
        self.networks = instance.numpy_networks()
        self.constants = tuple(np.asarray(instance.weights["constants"], dtype=np.float64))
        self.condition = tuple(np.asarray(plan.condition, dtype=np.float64))
        coordinates = coordinates_of(model)
        self.relative = np.array([each.logarithm for each in coordinates])
        self.logits = [(i, each) for i, each in enumerate(coordinates) if each.high is not None]
        self.arrivals: dict[float, list[tuple[int, float]]] = {}
        terms = self.equations.doses(self.ops, self.condition, self.constants)
        for dose, (fraction, lag), events in zip(model.doses, terms, plan.doses, strict=True):
            for time, amount in zip(events.times, events.amounts, strict=True):
                place = (model.state_index[dose.state], float(amount) * float(fraction))
                self.arrivals.setdefault(float(time) + float(lag), []).append(place)
        jumps = [float(t) for signal in plan.inputs for t in signal.times]
        self.edges = sorted({*self.arrivals, *jumps})

    def inputs(self, t: float) -> tuple[float, ...]:
        """The inputs at a time."""
        from gbspec.data import evaluate

        pairs = zip(self.plan.inputs, self.model.inputs, strict=True)
        return tuple(float(evaluate(signal, item.interpolation, np.array([t]))[0]) for signal, item in pairs)

    def dosed(self, x: Array, t: float) -> Array:
        """The states after the doses at a time."""
        for place, amount in self.arrivals.get(t, ()):
            x = x.copy()
            x[place] += amount
        return x

    def step(self, x: Array, t: float, h: float, random: np.random.Generator) -> Array:
        """One sub-step."""
        u = [self.inputs(t + share * h) for share in (1e-9, 0.5, 1 - 1e-9)] if self.model.inputs else [()] * 3
        z = self._shaken(self._with_logits(x), u[0], h / 2, random)
        k1 = self._drift(t, z, u[0])
        k2 = self._drift(t + h / 2, z + h / 2 * k1, u[1])
        k3 = self._drift(t + h / 2, z + h / 2 * k2, u[1])
        k4 = self._drift(t + h, z + h * k3, u[2])
        return self._states(self._shaken(z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), u[2], h / 2, random))

    def _with_logits(self, x: Array) -> Array:
        """The states, with logits for those that have them."""
        z = x.copy()
        for i, each in self.logits:
            z[i] = each.of(np.log, each.inside(x[i]))
        return z

    def _states(self, z: Array) -> Array:
        """The states of what `_with_logits` returns."""
        x = z.copy()
        with np.errstate(over="ignore"):
            for i, each in self.logits:
                x[i] = each.state(np.exp, z[i])
        return x

    def _drift(self, t: float, z: Array, u: tuple[float, ...]) -> Array:
        x = self._states(z)
        with np.errstate(all="ignore"):
            found = self.equations.rhs(self.ops, t, x, self.condition, u, self.constants, self.networks)
            rate = np.array(found, dtype=np.float64)
            if self.logits:
                square = self._sizes(x, u) ** 2
                for i, each in self.logits:
                    rate[i] = each.drift(np.exp, rate[i], square[i], z[i], x[i])
        return rate

    def _sizes(self, x: Array, u: tuple[float, ...]) -> Array:
        """The sizes of the disturbances at states."""
        found = self.equations.diffusions(self.ops, x, self.condition, u, self.constants)
        return np.broadcast_to(np.asarray(found, dtype=np.float64), x.shape)

    def _shaken(self, z: Array, u: tuple[float, ...], h: float, random: np.random.Generator) -> Array:
        """The states and logits `z` after the disturbance alone for a time `h`."""
        x, sigma = z, self._sizes(self._states(z), u)
        w = np.sqrt(h) * random.standard_normal(len(x))
        with np.errstate(over="ignore", invalid="ignore"):
            factor = np.exp(np.where(self.relative, sigma * w - 0.5 * sigma**2 * h, 0.0))
            return np.asarray(np.where(self.relative, x * factor, x + sigma * w), dtype=np.float64)
