"""Doses inside the solver's sub-steps: what arrives and when, both of which may depend on learned constants.

A dose given at d arrives at d + lag. Where the lag is learned, the arrival moves through the sub-steps as training
goes on; the sub-step that it falls into is then taken in two parts, up to the arrival and from it on, whose lengths
depend on the lag. So the solution keeps the solver's order and is differentiable in the lag, and the sub-steps
themselves stay where they are. The torch graph takes the parts one after the other (`advance`); for the kernel they
are sub-steps of a packing of their own (`gbspec.training.cut_steps`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gbspec.training.affine import Field
from gbspec.training.packing import NODES, Integers

if TYPE_CHECKING:
    from gbspec.training.problem import Problem


@dataclass(frozen=True)
class SubStep:
    """A sub-step of each of B trajectories: start `t` and length `h` [B], `condition` [B, n_conditions], the inputs at
    the tableau's nodes, [B, n_inputs] each, and the doses that arrive: their numbers in the packing [L, B], each
    trajectory's in the order of time and -1 where there is none; None where nobody gets any. `grid` is what the
    generated `_grid` makes of `t` and `h`; None: made when it is needed."""

    t: Tensor
    h: Tensor
    condition: Tensor
    nodes: tuple[Tensor, ...]
    events: Integers | None
    grid: Any = None


def arrivals(problem: Problem, constants: Tensor) -> Integers:
    """Which doses arrive in which sub-step [L, T, N], -1 for none, at the constants [N, n_constants].

    Doses that would arrive before a trajectory's start count as given already; those at its end have no effect.
    """
    packed, events = problem.packed, problem.packed.doses
    if not len(events.time):
        return np.zeros((0, packed.depth, packed.trajectories), dtype=np.int64)
    time = arrival_times(problem, constants.detach().cpu()).numpy()
    places: dict[tuple[int, int], list[int]] = {}
    for event in np.argsort(time, kind="stable"):
        owner = int(events.owner[event])
        step = _step_at(packed.t[: packed.steps[owner], owner], packed.h[: packed.steps[owner], owner], time[event])
        if step is not None:
            places.setdefault((step, owner), []).append(int(event))
    layers = max((len(found) for found in places.values()), default=0)
    out = np.full((layers, packed.depth, packed.trajectories), -1, dtype=np.int64)
    for (step, owner), found in places.items():
        out[: len(found), step, owner] = found
    return out


def arrival_times(problem: Problem, constants: Tensor) -> Tensor:
    """When each dose would arrive [E] at the constants [N, n_constants], differentiable in them."""
    events, condition = problem.packed.doses, torch.from_numpy(problem.packed.condition)
    like = constants.new_zeros(len(constants))
    terms = problem.module._doses(problem.ops, condition, constants.unbind(1))
    lags = torch.stack([lag + like for _, lag in terms])
    return torch.from_numpy(events.time) + lags[torch.from_numpy(events.kind), torch.from_numpy(events.owner)]


def _step_at(begins: np.ndarray[Any, Any], lengths: np.ndarray[Any, Any], time: float) -> int | None:
    """The sub-step that a time falls into, a time within rounding of a boundary into the later one; None: outside."""
    if not len(begins) or not np.isfinite(time):
        return None
    end = begins[-1] + lengths[-1]
    tolerance = 1e-9 * (end - begins[0])
    if time < begins[0] - tolerance or time > end - tolerance:
        return None
    return int(np.searchsorted(begins, time + tolerance, side="right")) - 1


def advance(
    problem: Problem, x: Tensor, step: SubStep, k: Sequence[Tensor], networks: Any, field: Field | None = None
) -> Tensor:
    """The states [B, n_states] at the ends of a sub-step, from those at its start and the constants ([B] or [] each).

    `field` is the right-hand side with all that is constant put in; None: made of the generated one.
    """
    rhs = field or problem.module._field(problem.ops, step.condition, tuple(k), networks)
    if step.events is None or not (step.events >= 0).any():
        return _part(problem, x, step, None, None, rhs)
    terms = problem.module._doses(problem.ops, step.condition, k)
    doses, model = problem.packed.doses, problem.model
    begin, places = torch.zeros_like(step.h), torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
    for layer in step.events:
        for kind, (fraction, lag) in enumerate(terms):
            mine = (layer >= 0) & (doses.kind[layer] == kind)
            if not mine.any():
                continue
            given = torch.from_numpy(mine).to(x.device)
            if not doses.known[kind]:
                # The sub-steps begin where doses of a known lag arrive; for others, time passes first.
                arrival = torch.where(given, x.new_tensor(doses.time[layer]) + lag - step.t, begin)
                x = _part(problem, x, step, begin, arrival, rhs)
                begin = arrival
            amount = x.new_tensor(np.where(mine, doses.amount[layer], 0.0)) * fraction
            x = x + amount[:, None] * places[model.state_index[model.doses[kind].state]]
    return _part(problem, x, step, begin, step.h, rhs)


def _part(problem: Problem, x: Tensor, step: SubStep, begin: Tensor | None, end: Tensor | None, rhs: Field) -> Tensor:
    """One step of the solver over a part of a sub-step (times since its start), or over all of it."""
    module, nodes, grid = problem.module, step.nodes, step.grid
    if begin is not None and end is not None:
        h = end - begin
        grid = module._grid(problem.ops, step.t + begin, h)
        if nodes[0].shape[1]:
            # Inputs are straight lines within a sub-step.
            whole = torch.where(step.h > 0, step.h, torch.ones_like(step.h))
            shares = [(begin + node * h) / whole for node in NODES]
            nodes = tuple(nodes[0] + share[:, None] * (nodes[-1] - nodes[0]) for share in shares)
    elif grid is None:
        grid = module._grid(problem.ops, step.t, step.h)
    out: Tensor = module._step(problem.ops, rhs, grid, x, nodes)
    return out
