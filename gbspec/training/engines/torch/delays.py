"""Solutions with delays: the module's own steps, which see the solution so far, and their Jacobian.

A trajectory is one segment even where forcing replaces all states, since later steps look at the solution before. The
Jacobian comes from the whole graph, differentiated backwards for many measured values at once: sensitivities of states
at the ends of intervals do not suffice, as they do in `jacobian`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends import Networks, Value
from gbspec.training.engines.linearised import Jacobian
from gbspec.training.engines.torch.affine import Field
from gbspec.training.engines.torch.sub_steps import Deliveries, SubStep
from gbspec.training.problem import Integers, Parameters, Problem

BYTES = 64 * 1024**2
"""Approximate size of the largest array of a batch of backward passes."""


class Past(Protocol):
    """The solution so far of a batch (`_Past` of the module's template); `begin` [B]: the starts of the rows,
    `shortest`: their shortest delays [B]."""

    begin: Tensor
    shortest: Array

    def across(
        self, t: Tensor, h: Tensor, grid: Value, x: Tensor, u: Value, rhs: Field, smooth: bool, late: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The states after a step, and the delayed values there."""

    def values(self, times: Tensor, middle: Tensor) -> Tensor:
        """The delayed values at times [K, B], on the side of others."""


def past_of(
    problem: Problem, condition: Tensor, k: Sequence[Tensor], networks: Networks, owner: Integers, x: Tensor
) -> Past:
    """The past of rows, each of a trajectory `owner` [B], that begin with the states `x`."""
    begin, inputs = (x.new_tensor(table[owner]) for table in (problem.packed.start, problem.packed.inputs_before))
    made: Past = problem.module.equations.past((condition, tuple(k), networks), begin, x, inputs)
    return made


def follow(
    problem: Problem,
    steps: Sequence[SubStep],
    resets: Sequence[tuple[Tensor, Tensor] | None],
    past: Past,
    deliveries: Deliveries,
    rhs: Callable[[int], Field],
    x: Tensor,
) -> tuple[list[Tensor], list[Tensor]]:
    """States and delayed values of the live rows at their starts and at the end of each sub-step; `rhs` gives the
    right-hand side of the first rows."""
    ready = [_Step.of(step, deliveries) for step in steps]
    states, ends = [x], [past.values(past.begin[None], past.begin)[0]]
    known: list[Tensor] = []
    for number, (reset, step) in enumerate(zip(resets, steps, strict=False)):
        if not known:
            known = looked_ahead(past, ready[number : number + _reach(past, ready, number)])
        if reset is not None:
            given, kept = reset
            x = torch.addcmul(given, kept, x)
        live = len(step.t)
        x, late = advance(x[:live], step, ready[number], past, deliveries, rhs(live), reset is None, known.pop(0))
        states.append(x)
        ends.append(late)
    return states, ends


@dataclass(frozen=True)
class _Step:
    """A sub-step with the derivatives of its ends: start and length [B], grid and inputs at the nodes; `begin` and
    `end` [B] are its ends as numbers."""

    t: Tensor
    h: Tensor
    grid: Value
    nodes: tuple[Tensor, ...]
    begin: Array
    end: Array

    @classmethod
    def of(cls, step: SubStep, deliveries: Deliveries) -> _Step:
        t, h = deliveries.ends(step)
        moved = None if step.arrivals is None else deliveries.moved(step, step.arrivals)
        grid, nodes = (step.grid, step.nodes) if moved is None else moved
        begin, length = step.t.detach().cpu().numpy(), step.h.detach().cpu().numpy()
        return cls(t, h, grid, nodes, begin, begin + length)


def _reach(past: Past, steps: Sequence[_Step], number: int) -> int:
    """How many steps from `number` on look only at times before it; their delayed values are computed together."""
    first = steps[number]
    rows = len(first.begin)
    seen = first.begin + past.shortest[:rows]
    seen = seen + 1e-12 * np.abs(seen)
    count = 1
    while number + count < len(steps) and len(steps[number + count].end) == rows:
        if not bool((steps[number + count].end <= seen).all()):
            break
        count += 1
    return count


def looked_ahead(past: Past, steps: Sequence[_Step]) -> list[Tensor]:
    """The delayed values at the nodes of some steps [nodes, B, n_delays]."""
    rows = len(steps[0].t)
    times = torch.stack([node.expand(rows) for step in steps for node in step.grid[0]])
    nodes = len(times) // len(steps)
    middle = torch.stack([step.t + step.h / 2 for step in steps]).repeat_interleave(nodes, 0)
    found = past.values(times, middle)
    return [found[i * nodes : (i + 1) * nodes] for i in range(len(steps))]


def advance(
    x: Tensor,
    step: SubStep,
    ready: _Step,
    past: Past,
    deliveries: Deliveries,
    rhs: Field,
    smooth: bool,
    late: Tensor,
) -> tuple[Tensor, Tensor]:
    """The states at the end of a sub-step, and the delayed values there; `smooth`: no state was reset before it."""
    if step.arrivals is not None:
        x = deliveries.added(x, step.arrivals)
    problem = deliveries.problem
    # Jumps by resets show again within steps or between them, where rates differ on both sides; so do other jumps.
    jumping = problem.forcing.weight.any() or hasattr(problem.module.equations, "schedule")
    steady = not problem.model.inputs and not jumping
    smooth = smooth and step.arrivals is None and steady
    return past.across(ready.t, ready.h, ready.grid, x, ready.nodes, rhs, smooth, late)


def jacobian(
    parameters: Parameters,
    problem: Problem,
    predicted: Callable[[Tensor], Tensor],
    theta: Tensor,
    scale: Array,
    only_local: bool,
) -> Jacobian:
    """Derivatives of the measured values, from the graph of `predicted`, the means [R, C], each times its `scale`."""
    vector = theta.clone().requires_grad_()
    with torch.enable_grad():
        mean = predicted(vector)
    row, channel = np.nonzero(problem.seen)
    owner = problem.packed.row_trajectory[row]
    flat = (mean * mean.new_tensor(scale))[torch.from_numpy(row), torch.from_numpy(channel)]
    found = vector.new_zeros((len(row), parameters.size))
    widest = max([len(problem.model.states), *(n for network in problem.model.networks for n in network.sizes)])
    most = max(1, BYTES // (8 * widest * max(problem.packed.trajectories, 1)))
    for first in range(0, len(row) if flat.requires_grad else 0, most):
        count = min(most, len(row) - first)
        towards = vector.new_zeros((count, len(row)))
        towards[torch.arange(count), first + torch.arange(count)] = 1.0
        (part,) = torch.autograd.grad(
            flat, vector, towards, retain_graph=True, is_grads_batched=True, allow_unused=True
        )
        if part is not None:
            found[first : first + count] = part
    shared = found[:, : 0 if only_local else parameters.n_shared]
    blocks = found[:, parameters.n_shared :].reshape(len(row), parameters.trajectories, parameters.n_local)
    own = torch.from_numpy(owner)
    return Jacobian(shared.detach(), blocks[torch.arange(len(row)), own].detach(), own)
