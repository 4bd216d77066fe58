"""The unrolled solver: all trajectories of a packed batch stepped together, and the residuals at their key rows."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gbspec.data.trajectories import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.engines.torch import memory
from gbspec.training.engines.torch.affine import Affine, Field, NotAffineError, affine
from gbspec.training.engines.torch.doses import SubStep, advance, arrivals
from gbspec.training.engines.torch.segments import Schedule
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem

LOG_FLOOR = 1e-3
"""Below this fraction of the measured value, the logarithm of a prediction is continued by its tangent."""


@dataclass(frozen=True)
class Unrolled:
    """`arrival` [R, n_states]: states on arrival at each key row (before resets and doses); `departure`: after resets;
    `initial` [N, n_states]; `residuals` [R, C], 0 where nothing was measured."""

    arrival: Tensor
    departure: Tensor
    initial: Tensor
    residuals: Tensor


def unroll(problem: Problem, parameters: Parameters, theta: Tensor) -> Unrolled:
    """Steps every trajectory from its initial state through its key rows; differentiable in `theta`.

    The work is done on the problem's device; `theta` and what comes out are on that of `theta`. Without gradients, a
    problem's kernel does it, where it has one.
    """
    if problem.kernel is not None and not (torch.is_grad_enabled() and theta.requires_grad):
        return _by_kernel(problem, parameters, theta)
    packed, module = problem.packed, problem.module
    m, home, theta = problem.ops, theta.device, theta.to(problem.device)
    networks = module.torch_networks(parameters.weights(theta))
    constants = parameters.constants(theta)
    k = tuple(constants[:, i] for i in range(constants.shape[1]))
    initial = module._initial(m, parameters.starts(theta), theta.new_tensor(packed.condition), k)
    schedule = problem.schedule_in_float32 if theta.dtype == torch.float32 else problem.schedule
    x = torch.where(schedule.fresh, initial[schedule.owner], schedule.start)
    motion = Motion(problem, schedule, parameters.own, constants, networks)
    passed = torch.cat(_run(problem, schedule, motion, x, schedule.with_doses(problem, constants)))
    arrival = passed[schedule.row]
    value, weight = theta.new_tensor(problem.forcing.value), theta.new_tensor(problem.forcing.weight)
    owner = torch.from_numpy(packed.row_trajectory).to(theta.device)
    residuals = row_residuals(problem, arrival, constants[owner], networks)
    departure = arrival - weight * (arrival - value)
    return Unrolled(arrival.to(home), departure.to(home), initial.to(home), residuals.to(home))


def _by_kernel(problem: Problem, parameters: Parameters, theta: Tensor) -> Unrolled:
    """The same through the native kernel; no gradient passes."""
    from gbspec.training.engines.native.gradient import solved

    residuals, arrival, initial = map(torch.from_numpy, solved(problem, parameters, theta))
    value, weight = torch.from_numpy(problem.forcing.value), torch.from_numpy(problem.forcing.weight)
    return Unrolled(arrival, arrival - weight * (arrival - value), initial, residuals)


def _run(problem: Problem, schedule: Schedule, motion: Motion, x: Tensor, steps: Sequence[SubStep]) -> list[Tensor]:
    """States of the live pieces at their starts and on arrival after each sub-step, from `x` [P, n_states]."""
    passed = [x]
    # Made beforehand, so that a stretch that is computed again finds them as it did the first time.
    flows = {live: motion.of(slice(live)) for live in {len(step.t) for step in steps}}

    def stretch(x: Tensor, begin: int, end: int) -> tuple[Tensor, ...]:
        out = []
        for reset, step in zip(schedule.resets[begin:end], steps[begin:end], strict=True):
            if reset is not None:
                given, kept = reset
                x = torch.addcmul(given, kept, x)
            live = len(step.t)
            x = advance(problem, x if live == len(x) else x[:live], step, *flows[live])
            out.append(x)
        return tuple(out)

    def single(count: int) -> Tensor:
        """The first piece's first sub-step, done `count` times."""
        first, row = steps[0], torch.zeros(count, dtype=torch.int64, device=x.device)
        nodes = tuple(node[row] for node in first.nodes)
        step = SubStep(first.t[row], first.h[row], first.condition[row], nodes, None)
        return advance(problem, x[row], step, *motion.of(row))

    every = [(0, len(steps))]
    if torch.is_grad_enabled():
        every = memory.parts([len(step.t) for step in steps], lambda: memory.kept_bytes(single))
    for begin, end in every:
        if len(every) == 1:
            passed += stretch(passed[-1], begin, end)
        else:
            passed += checkpoint(stretch, passed[-1], begin, end, use_reentrant=False, preserve_rng_state=False)
    return passed


class Motion:
    """What moves the pieces of a schedule: constants and right-hand side, those that all pieces share computed once.

    `own`: which learnables each trajectory has for itself; `constants` [N, n_constants].
    """

    def __init__(
        self, problem: Problem, schedule: Schedule, own: Sequence[int], constants: Tensor, networks: Any
    ) -> None:
        self._problem, self._networks, self._condition = problem, networks, schedule.condition
        single = {len(problem.model.constants) + i for i in own}
        # All rows hold the same value of a constant that is shared: one number serves in its place.
        self._constants = [
            column[schedule.owner] if i in single or not len(column) else column[0]
            for i, column in enumerate(constants.unbind(1))
        ]
        self._affine: Affine | None = None
        with suppress(NotAffineError):
            if not problem.model.arrays:
                self._affine = affine(problem.module, problem.ops, schedule.condition, self._constants, networks)

    def of(self, rows: slice | Tensor) -> tuple[tuple[Tensor, ...], Any, Field]:
        """For some of the pieces: constants, networks, and the right-hand side."""
        k = tuple(value[rows] if value.ndim else value for value in self._constants)
        if self._affine is not None:
            return k, self._networks, self._affine.at(rows)
        condition = self._condition[rows].unbind(1)
        return k, self._networks, self._problem.module._field(self._problem.ops, condition, k, self._networks)


def _sub_steps(problem: Problem, constants: Tensor) -> list[SubStep]:
    """Every sub-step of all trajectories, with the doses that arrive in it at the constants [N, n_constants]."""
    packed = problem.packed
    t, h, inputs = torch.from_numpy(packed.t), torch.from_numpy(packed.h), torch.from_numpy(packed.inputs)
    c, events = torch.from_numpy(packed.condition), arrivals(problem, constants)
    return [
        SubStep(t[s], h[s], c, inputs[s].unbind(1), events[:, s] if len(events) else None) for s in range(packed.depth)
    ]


def _reset_tables(problem: Problem) -> tuple[list[Tensor | None], list[Tensor | None]]:
    """Reset values and reset weights by step and trajectory; None at steps without any."""
    packed = problem.packed
    shape = (packed.depth + 1, packed.trajectories, len(problem.model.states))
    at = (packed.row_step, packed.row_trajectory)
    tables = []
    for rows in (problem.forcing.value, problem.forcing.weight):
        table = np.zeros(shape)
        table[at] = rows
        tables.append(table)
    value, weight = tables
    used = [bool(table.any()) for table in weight]
    return (
        [torch.from_numpy(value[s]) if used[s] else None for s in range(shape[0])],
        [torch.from_numpy(weight[s]) if used[s] else None for s in range(shape[0])],
    )


def observe_rows(problem: Problem, states: Tensor, constants: Tensor, networks: Any) -> Tensor:
    """Predicted channels at the key rows [R, C], from states [R, n_states] and constants [R, n_constants]."""
    packed = problem.packed
    k = tuple(constants[:, i] for i in range(constants.shape[1]))
    c = states.new_tensor(packed.condition[packed.row_trajectory])
    t, u = states.new_tensor(packed.row_time), states.new_tensor(packed.row_inputs)
    predicted: Tensor = problem.module._observe(problem.ops, t, states, c, u, k, networks)
    return predicted


def row_residuals(problem: Problem, arrival: Tensor, constants: Tensor, networks: Any) -> Tensor:
    """Residuals [R, C]; 0 where nothing was measured."""
    predicted = observe_rows(problem, arrival, constants, networks)
    return residuals_of(problem, predicted)


def residuals_of(problem: Problem, predicted: Tensor) -> Tensor:
    """Residuals [R, C] of predicted channels [R, C] (see `problem`)."""
    packed, scaling = problem.packed, problem.scaling
    seen = packed.weights > 0
    measured = predicted.new_tensor(np.where(seen, packed.values, 1.0))
    factor = predicted.new_tensor(np.where(seen, packed.weights / scaling.row_scale, 0.0))
    difference = predicted - measured
    if scaling.log.any():
        ratio = predicted / measured.abs().clamp_min(1e-300)
        safe = ratio.clamp_min(LOG_FLOOR)
        logarithm = torch.log(safe) + (ratio - safe) / LOG_FLOOR
        difference = torch.where(torch.from_numpy(scaling.log).to(predicted.device), logarithm, difference)
    return torch.where(factor > 0, difference * factor, torch.zeros_like(difference))


def measured_residuals(problem: Problem, residuals: Tensor) -> Tensor:
    """The residuals of measured values alone, as a vector, row by row."""
    return residuals[torch.from_numpy(problem.packed.weights > 0)]


def solve(problem: Problem, parameters: Parameters, theta: Array) -> Array:
    """The residuals of measured values at `theta` (no gradient); may hold NaN or infinities after a blow-up."""
    with torch.no_grad():
        out = unroll(problem, parameters, torch.from_numpy(theta))
        return np.asarray(measured_residuals(problem, out.residuals).numpy(), dtype=np.float64)


def explain_failure(problem: Problem, parameters: Parameters, theta: Array, stage: str) -> ComputationError:
    """What went wrong in a solution that left the finite numbers: which trajectory, when, and in which balance."""
    packed = problem.packed
    with torch.no_grad():
        vector = torch.from_numpy(theta)
        if not np.isfinite(theta).all():
            return ComputationError(
                f"the parameters are no longer numbers in stage `{stage}`",
                remedy="lower `--learning-rate`, or use `--method auto`",
            )
        found = _first_failure(problem, parameters, vector)
    if found is None:
        return ComputationError(f"a residual is not a finite number in stage `{stage}`", remedy=_REMEDY)
    trajectory, time, term, state = found
    values = ", ".join(f"{s.name} = {v:.6g}" for s, v in zip(problem.model.states, state, strict=True))
    return ComputationError(
        f"the solution blew up in stage `{stage}`: {term}",
        where=f"trajectory `{packed.labels[trajectory]}` at {problem.model.time.name} = {time:.6g}, where {values}",
        remedy=_REMEDY,
    )


_REMEDY = (
    "try a smaller `--max-step`, bounds on the learned constants (`learn k = 1 in [0, 10]`), "
    "or a range and a start for each state (`state x in [0, 1] = 0.5`)"
)


def _first_failure(problem: Problem, parameters: Parameters, theta: Tensor) -> tuple[int, float, str, Array] | None:
    """The first trajectory and time whose state is not finite, the balance to blame, and the last finite state."""
    packed, module, m = problem.packed, problem.module, problem.ops
    networks = module.torch_networks(parameters.weights(theta))
    constants = parameters.constants(theta)
    k = tuple(constants[:, i] for i in range(constants.shape[1]))
    c = torch.from_numpy(packed.condition)
    x = module._initial(m, parameters.starts(theta), c, k)
    value, weight = _reset_tables(problem)
    steps = _sub_steps(problem, constants)
    names = [s.name for s in problem.model.states]
    bad = ~torch.isfinite(x)
    if bad.any():
        i = int(torch.nonzero(bad)[0, 0])
        which = ", ".join(f"`{names[j]}`" for j in torch.nonzero(bad[i])[:, 0].tolist())
        return i, float(packed.start[i]), f"the initial state of {which} is not finite", x[i].numpy()
    for s in range(packed.depth + 1):
        if s > 0:
            step = steps[s - 1]
            new = advance(problem, x, step, k, networks)
            bad = ~torch.isfinite(new)
            if bad.any():
                i = int(torch.nonzero(bad.any(-1))[0, 0])
                rhs = module._rhs(m, step.t, x, c, step.nodes[0], k, networks)[i]
                return i, float(packed.t[s - 1, i]), _blame(names, rhs, bad[i]), x[i].numpy()
            x = new
        if weight[s] is not None:
            x = x - weight[s] * (x - value[s])
    return None


def _blame(names: list[str], rhs: Tensor, bad: Tensor) -> str:
    """Names the balances that are not finite at the last finite state, else those whose step diverges."""
    broken = [names[j] for j in torch.nonzero(~torch.isfinite(rhs))[:, 0].tolist()]
    if broken:
        return "the right-hand side of " + ", ".join(f"`{n}'`" for n in broken) + " is not finite"
    diverging = torch.nonzero(bad)[:, 0].tolist()
    parts = ", ".join(f"`{names[j]}'` = {float(rhs[j]):.4g}" for j in diverging)
    return f"the step diverges in {parts}"
