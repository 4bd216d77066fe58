"""The reactor fitted with diffrax and optax's Adam with a one-cycle schedule, in minibatches, compiled as one step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks.peers.diffrax_solve import Loss, one_solve_loss, scan_of_solves_loss
from benchmarks.peers.jax_scan import parameters
from benchmarks.workload import Workload

RATE = 1e-2
"""Peak learning rate of weights and initial states."""
CONSTANTS = 5.0
"""Factor of the learning rate for constants: they are few, and their starting values are far off."""
BATCH = 25
"""Trajectories in a minibatch."""


def fit_teacher_forced(
    work: Workload, steps: Callable[[Callable[[], None]], int], record: Callable[[Any], None]
) -> None:
    """Fits by a scan of solves with teacher forcing."""
    _fit(work, scan_of_solves_loss(work, jnp.float32), steps, record)


def fit_autoregressive(
    work: Workload, steps: Callable[[Callable[[], None]], int], record: Callable[[Any], None]
) -> None:
    """Fits by one solve per trajectory."""
    _fit(work, one_solve_loss(work.autoregressive(), jnp.float32), steps, record)


def _fit(
    work: Workload,
    loss_and_data: tuple[Loss, Any],
    steps: Callable[[Callable[[], None]], int],
    record: Callable[[Any], None],
) -> None:
    loss, data = loss_and_data
    count = work.size.trajectories
    batch = min(BATCH, count)
    p = parameters(work, jnp.float32)
    p["constants"] = jnp.log(p["constants"])
    optimiser = optax.scale_by_adam()

    def natural(p: Any) -> Any:
        return {**p, "constants": jnp.exp(p["constants"])}

    @jax.jit
    def update(p: Any, state: Any, rate: Any, index: Any) -> Any:
        def part(p: Any) -> Any:
            chosen = jax.tree.map(lambda a: a[index], data)
            return loss({**natural(p), "start": p["start"][index]}, chosen)

        changes, state = optimiser.update(jax.grad(part)(p), state)
        changes["constants"] *= CONSTANTS
        return jax.tree.map(lambda a, change: a - rate * change, p, changes), state

    rng, state = np.random.default_rng(0), optimiser.init(p)

    def step(rate: float = 0.0) -> None:
        nonlocal p, state
        index = jnp.asarray(rng.choice(count, batch, replace=False))
        p, state = jax.block_until_ready(update(p, state, jnp.float32(rate), index))

    total = steps(step)
    schedule = optax.cosine_onecycle_schedule(total, RATE)
    state = optimiser.init(p)
    for i in range(total):
        step(float(schedule(i)))
        record(([np.asarray(a) for layer in p["layers"] for a in layer], np.exp(np.asarray(p["constants"]))))
