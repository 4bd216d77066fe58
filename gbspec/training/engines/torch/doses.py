"""Doses inside the solver's sub-steps: what arrives and when, both of which may depend on learned constants.

A dose given at d arrives at d + lag. Where the lag is learned, the arrival moves through the sub-steps as training
goes on; the sub-step that it falls into is then taken in two parts, up to the arrival and from it on, whose lengths
depend on the lag. So the solution keeps the solver's order and is differentiable in the lag, and the sub-steps
themselves stay where they are. The torch graph takes the parts one after the other (`advance`); for the kernel they
are sub-steps of a packing of their own (`gbspec.training.engines.native.cut_steps`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gbspec.data.trajectories import Array
from gbspec.training.engines.torch.affine import Field
from gbspec.training.problem.packing import Integers, Packed

if TYPE_CHECKING:
    from gbspec.training.problem.problem import Problem


@dataclass(frozen=True)
class SubStep:
    """A sub-step of each of B trajectories: start `t` and length `h` [B], `condition` [B, n_conditions], the inputs at
    the method's nodes, [B, n_inputs] each, and the doses that arrive: their numbers in the packing [L, B], each
    trajectory's in the order of time and -1 where there is none; None where nobody gets any. `grid` is what the
    generated `_grid` makes of `t` and `h`; None: made when it is needed."""

    t: Tensor
    h: Tensor
    condition: Tensor
    nodes: tuple[Tensor, ...]
    events: Integers | None
    grid: Any = None


def terms_of(problem: Problem, condition: Tensor, k: Sequence[Tensor]) -> list[tuple[Any, Any]]:
    """Fraction and lag of each of the model's doses for B trajectories, from their conditions [B, n_conditions] and
    constants ([B] or [] each). Where conditions leave a lag undefined no gradient passes, which would not be finite."""
    terms: list[tuple[Any, Any]] = list(problem.module._doses(problem.ops, condition, k))
    for kind, (fraction, lag) in enumerate(terms):
        if not isinstance(lag, Tensor) or not lag.requires_grad or not lag.ndim:
            continue
        sound = torch.isfinite(lag.detach())
        if not bool(sound.all()):
            some = [column[sound] if column.ndim else column for column in k]
            of_some = problem.module._doses(problem.ops, condition[sound], some)[kind][1]
            terms[kind] = fraction, lag.detach().masked_scatter(sound, of_some)
    return terms


def delivered(problem: Problem, constants: Tensor) -> tuple[Tensor, Tensor]:
    """How much of each dose would arrive and when [E], at the constants [N, n_constants]; differentiable in them."""
    events = problem.packed.doses
    if not len(events.time):
        return constants.new_zeros(0), constants.new_zeros(0)
    terms = terms_of(problem, torch.from_numpy(problem.packed.condition), constants.unbind(1))
    like, place = constants.new_zeros(len(constants)), (torch.from_numpy(events.kind), torch.from_numpy(events.owner))
    fraction, lag = (torch.stack([pair[i] + like for pair in terms])[place] for i in range(2))
    return fraction * torch.from_numpy(events.amount), torch.from_numpy(events.time) + lag


def arrival_steps(packed: Packed, time: Array) -> Integers:
    """The sub-step in which each dose arrives that would do so at `time` [E]; -1: in none.

    A time within rounding of a boundary is in the later one. Doses that would arrive before a trajectory's start count
    as given already; those at its end have no effect.
    """
    owner, out = packed.doses.owner, np.full(len(time), -1, dtype=np.int64)
    given = np.flatnonzero(np.isfinite(time) & (packed.steps[owner] > 0))
    given = given[np.argsort(owner[given], kind="stable")]
    whose, first = np.unique(owner[given], return_index=True)
    # Of no doses at all there is one part too, and no trajectory.
    for i, mine in zip(whose, np.split(given, first[1:]), strict=False):
        n = packed.steps[i]
        begins, end = packed.t[:n, i], packed.t[n - 1, i] + packed.h[n - 1, i]
        tolerance = 1e-9 * (end - begins[0])
        step = np.searchsorted(begins, time[mine] + tolerance, side="right") - 1
        inside = (time[mine] >= begins[0] - tolerance) & (time[mine] <= end - tolerance)
        out[mine] = np.where(inside, step, -1)
    return out


def in_order(packed: Packed, time: Array) -> tuple[Integers, Integers, Integers]:
    """The sub-step of each dose [E] (see `arrival_steps`); those that arrive [A], trajectory by trajectory in the order
    of time; and for these a number that is the same in one sub-step of one trajectory."""
    step, owner = arrival_steps(packed, time), packed.doses.owner
    order = np.lexsort((time, step, owner))
    order = order[step[order] >= 0]
    return step, order, owner[order] * (packed.depth + 1) + step[order]


def arrivals(problem: Problem, constants: Tensor) -> Integers:
    """Which doses arrive in which sub-step [L, T, N], in the order of time and -1 for none, at the constants
    [N, n_constants]."""
    packed, owner = problem.packed, problem.packed.doses.owner
    if not len(owner):
        return np.zeros((0, packed.depth, packed.trajectories), dtype=np.int64)
    time = delivered(problem, constants.detach().cpu())[1].numpy()
    step, order, cell = in_order(packed, time)
    rank = np.arange(len(order)) - np.searchsorted(cell, cell)
    out = np.full((int(rank.max(initial=-1)) + 1, packed.depth, packed.trajectories), -1, dtype=np.int64)
    out[rank, step[order], owner[order]] = order
    return out


def advance(
    problem: Problem, x: Tensor, step: SubStep, k: Sequence[Tensor], networks: Any, field: Field | None = None
) -> Tensor:
    """The states [B, n_states] at the ends of a sub-step, from those at its start and the constants ([B] or [] each).

    `field` is the right-hand side with all that is constant put in; None: made of the generated one.
    """
    rhs = field or problem.module._field(problem.ops, step.condition, tuple(k), networks)
    if step.events is None or not (step.events >= 0).any():
        return _part(problem, x, step, None, None, rhs)
    terms = terms_of(problem, step.condition, k)
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
            shares = [(begin + node * h) / whole for node in problem.packed.nodes]
            nodes = tuple(nodes[0] + share[:, None] * (nodes[-1] - nodes[0]) for share in shares)
    elif grid is None:
        grid = module._grid(problem.ops, step.t, step.h)
    out: Tensor = module._step(problem.ops, rhs, grid, x, nodes)
    return out
