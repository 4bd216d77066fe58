"""diffrax with the classical tableau: one autoregressive solve, or a scan of solves with teacher forcing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers.jax_scan import Step, parameters, right_hand_side, scales
from benchmarks.workload import Workload

Loss = Callable[[Any, Any], Any]
"""Function of parameters, and of data whose first axis is that of trajectories."""


class RK4(diffrax.AbstractERK):
    """The classical Runge-Kutta method (diffrax does not provide it)."""

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        c=np.array([0.5, 0.5, 1.0]),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
    )
    interpolation_cls: ClassVar[Callable[..., Any]] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: Any) -> int:
        """The order of the method."""
        return 4


def field(t: Any, x: Any, arguments: Any) -> Any:
    """The vector field of one trajectory."""
    p, fixed, condition = arguments
    return right_hand_side(p, fixed, condition)(x)


def one_solve_loss(work: Workload, dtype: Any) -> tuple[Loss, Any]:
    """One solve per trajectory through its own sub-steps (shorter ones are padded to the same number)."""
    h = work.h.T
    end = h.sum(axis=1).max() + 1.0
    edges = np.concatenate([np.zeros((len(h), 1)), np.cumsum(h, axis=1)], axis=1)
    for row, length in zip(edges, (h > 0).sum(axis=1), strict=True):
        row[length:] = np.linspace(row[length], end, len(row) - length)
    fixed, depth = scales(work, dtype), len(work.h)

    def solve(p: Any, start: Any, condition: Any, ts: Any) -> Any:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            RK4(),
            t0=ts[0],
            t1=ts[-1],
            dt0=None,
            y0=start,
            args=(p, fixed, condition),
            saveat=diffrax.SaveAt(t0=True, steps=True),
            stepsize_controller=diffrax.StepTo(ts),
            max_steps=depth,
        )
        return solution.ys

    def loss(p: Any, data: Any) -> Any:
        condition, ts, value, weight = data
        states = jax.vmap(solve, in_axes=(None, 0, 0, 0))(p, p["start"], condition, ts)
        return (weight * (states - value) ** 2).sum()

    arrays = (work.condition, edges, work.value.swapaxes(0, 1), work.weight.swapaxes(0, 1))
    return loss, tuple(jnp.asarray(a, dtype) for a in arrays)


def scan_of_solves_loss(work: Workload, dtype: Any) -> tuple[Loss, Any]:
    """A scan over the key times: each trajectory is solved to its own next one, followed by teacher forcing."""
    fixed, longest = scales(work, dtype), int(work.count.max())

    def solve(p: Any, start: Any, condition: Any, end: Any, step: Any) -> Any:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            RK4(),
            t0=jnp.zeros((), dtype),
            t1=end,
            dt0=step,
            y0=start,
            args=(p, fixed, condition),
            max_steps=longest + 1,
        )
        return solution.ys[0]

    def loss(p: Any, data: Any) -> Any:
        condition, *rows = data

        def body(carry: Any, row: Any) -> Any:
            x, total = carry
            end, step, value, mask, weight = row
            x = jax.vmap(solve, in_axes=(None, 0, 0, 0, 0))(p, x, condition, end, step)
            deviation = x - value
            return (x - work.blend * mask * deviation, total + (weight * deviation**2).sum()), None

        turned = tuple(a.swapaxes(0, 1) for a in rows)
        (_, total), _ = jax.lax.scan(body, (p["start"], jnp.zeros((), dtype)), turned)
        return total

    step = np.where(work.count > 0, work.interval / np.maximum(work.count, 1), 1.0)
    weight = 0.5 * work.row_mask / work.scale**2 / work.measured
    rows = (work.interval, step, work.row_value, work.row_mask, weight)
    return loss, tuple(jnp.asarray(a, dtype) for a in (work.condition, *(row.swapaxes(0, 1) for row in rows)))


def _step(work: Workload, dtype: Any, loss: Loss, data: Any) -> Step:
    p = parameters(work, dtype)
    compiled = jax.jit(jax.value_and_grad(loss)).lower(p, data).compile()
    return lambda: jax.block_until_ready(compiled(p, data))


def one_solve(work: Workload, dtype: Any) -> Step:
    """The step by `one_solve_loss`."""
    return _step(work, dtype, *one_solve_loss(work, dtype))


def scan_of_solves(work: Workload, dtype: Any) -> Step:
    """The step by `scan_of_solves_loss`."""
    return _step(work, dtype, *scan_of_solves_loss(work, dtype))
