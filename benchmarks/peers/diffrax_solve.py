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


class RK4(diffrax.AbstractERK):
    """The classical method (diffrax has none of its own)."""

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        c=np.array([0.5, 0.5, 1.0]),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
    )
    interpolation_cls: ClassVar[Callable[..., Any]] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: Any) -> int:
        """Of the method."""
        return 4


def field(t: Any, x: Any, arguments: Any) -> Any:
    """The vector field of one trajectory."""
    p, fixed, condition = arguments
    return right_hand_side(p, fixed, condition)(x)


def one_solve(work: Workload, dtype: Any) -> Step:
    """One solve a trajectory, stepping through its own sub-steps (those that are done early go on, to as many)."""
    h = work.h.T
    end = h.sum(axis=1).max() + 1.0
    edges = np.concatenate([np.zeros((len(h), 1)), np.cumsum(h, axis=1)], axis=1)
    for row, length in zip(edges, (h > 0).sum(axis=1), strict=True):
        row[length:] = np.linspace(row[length], end, len(row) - length)
    at, owner, channel = np.nonzero(work.mask)
    value = jnp.asarray(work.value[at, owner, channel], dtype)
    weight = jnp.asarray(work.weight[at, owner, channel], dtype)
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

    def loss(p: Any, condition: Any, ts: Any, value: Any, weight: Any) -> Any:
        states = jax.vmap(solve, in_axes=(None, 0, 0, 0))(p, p["start"], condition, ts)
        return (weight * (states[owner, at, channel] - value) ** 2).sum()

    arguments = (parameters(work, dtype), jnp.asarray(work.condition, dtype), jnp.asarray(edges, dtype), value, weight)
    compiled = jax.jit(jax.value_and_grad(loss)).lower(*arguments).compile()
    return lambda: jax.block_until_ready(compiled(*arguments))


def scan_of_solves(work: Workload, dtype: Any) -> Step:
    """A scan over the key times; in each a solve of every trajectory to its own next one, then teacher forcing."""
    fixed, longest = scales(work, dtype), int(work.count.max())
    weight = 0.5 * work.row_mask / work.scale**2 / work.measured
    step = work.interval / np.maximum(work.count, 1)

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

    def loss(p: Any, condition: Any, rows: Any) -> Any:
        def body(carry: Any, row: Any) -> Any:
            x, total = carry
            end, step, value, mask, weight = row
            x = jax.vmap(solve, in_axes=(None, 0, 0, 0, 0))(p, x, condition, end, step)
            deviation = x - value
            return (x - work.blend * mask * deviation, total + (weight * deviation**2).sum()), None

        (_, total), _ = jax.lax.scan(body, (p["start"], jnp.zeros((), dtype)), rows)
        return total

    rows = tuple(jnp.asarray(a, dtype) for a in (work.interval, step, work.row_value, work.row_mask, weight))
    arguments = (parameters(work, dtype), jnp.asarray(work.condition, dtype), rows)
    compiled = jax.jit(jax.value_and_grad(loss)).lower(*arguments).compile()
    return lambda: jax.block_until_ready(compiled(*arguments))
