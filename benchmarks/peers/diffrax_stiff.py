"""diffrax's implicit Kvaerno methods with adaptive steps: one solve for each trajectory, together by `vmap`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.stiff_workload import StiffWork

METHODS = {"Kvaerno3": diffrax.Kvaerno3, "Kvaerno5": diffrax.Kvaerno5}

MOST_STEPS = 4096
"""diffrax's default."""


def parameters(work: StiffWork) -> dict[str, Any]:
    """What the gradient is by, in the order of `StiffWork.natural`."""
    return {
        "layers": [tuple(jnp.asarray(part) for part in layer) for layer in work.layers],
        "rates": jnp.log(jnp.asarray(work.rates)),
        "start": jnp.asarray(work.start),
    }


def flat(gradient: dict[str, Any]) -> np.ndarray[Any, Any]:
    """A gradient as one vector, in the order of `StiffWork.natural`."""
    parts = [part for layer in gradient["layers"] for part in layer]
    return np.concatenate([np.asarray(part).ravel() for part in (*parts, gradient["rates"], gradient["start"])])


def right_hand_side(work: StiffWork) -> Callable[[Any, Any, Any], Any]:
    """The vector field of one trajectory in scaled states; the scale is that of the tolerances."""
    scale, center, width = jnp.asarray(work.scale), work.output_center, work.output_scale
    inputs = jnp.asarray(work.input_scale)

    def network(layers: Any, y2: Any, y3: Any) -> Any:
        y = jnp.stack([y2, y3])
        inner = y / inputs
        for weight, bias in layers[:-1]:
            inner = jax.nn.silu(weight @ inner + bias)
        weight, bias = layers[-1]
        raw = (weight @ inner + bias)[0]
        return (y / jnp.sqrt(y**2 + inputs**2)).prod() * (center + width * raw)

    def field(t: Any, z: Any, p: Any) -> Any:
        y1, y2, y3 = z * scale
        k = jnp.exp(p["rates"])
        fast = network(p["layers"], y2, y3) if work.layers else k[2] * y2 * y3
        slow, very_fast = k[0] * y1, k[1] * y2**2
        return jnp.stack([fast - slow, slow - very_fast - fast, very_fast]) / scale

    return field


class Peer:
    """States, and loss with gradient, by one method; compiled once for all tolerances."""

    def __init__(self, work: StiffWork, method: str) -> None:
        field, scale = right_hand_side(work), jnp.asarray(work.scale)
        times, value, weight = (jnp.asarray(a) for a in (work.times, work.value, work.weight))
        self._parameters = parameters(work)

        def solve(start: Any, p: Any, rtol: Any) -> Any:
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                METHODS[method](),
                t0=0.0,
                t1=times[-1],
                dt0=None,
                y0=start / scale,
                args=p,
                saveat=diffrax.SaveAt(ts=times),
                stepsize_controller=diffrax.PIDController(rtol=rtol, atol=work.floor * rtol),
                max_steps=MOST_STEPS,
                throw=False,
            )
            return solution.ys * scale, solution.stats["num_steps"]

        def states(p: Any, rtol: Any) -> Any:
            return jax.vmap(solve, in_axes=(0, None, None))(p["start"], p, rtol)

        def loss(p: Any, rtol: Any) -> Any:
            return (weight * (states(p, rtol)[0] - value) ** 2).sum()

        self._states, self._loss = jax.jit(states), jax.jit(jax.value_and_grad(loss))

    def states(self, rtol: float) -> tuple[np.ndarray[Any, Any], float]:
        """States [N, T, 3] and the mean number of steps, rejected ones included."""
        found, steps = self._states(self._parameters, rtol)
        return np.asarray(found), float(np.mean(steps))

    def step(self, rtol: float) -> Callable[[], tuple[float, np.ndarray[Any, Any]]]:
        """Loss and gradient, in the order of `StiffWork.natural`, as a call without arguments."""

        def call() -> tuple[float, np.ndarray[Any, Any]]:
            loss, gradient = jax.block_until_ready(self._loss(self._parameters, rtol))
            return float(loss), flat(gradient)

        return call
