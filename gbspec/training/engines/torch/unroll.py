"""The unrolled solver: all trajectories of a packed batch stepped together, and the predictions at their key rows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gbspec.backends import Networks, Value
from gbspec.ir import residuals
from gbspec.training.engines.arithmetic import observe_rows, torch_arithmetic
from gbspec.training.engines.starting import initial_states
from gbspec.training.engines.torch import memory
from gbspec.training.engines.torch.affine import Affine, Field, affine, affine_by_model
from gbspec.training.engines.torch.delays import follow, past_of
from gbspec.training.engines.torch.segments import Schedule
from gbspec.training.engines.torch.sub_steps import Cutting, Deliveries, SubStep, advance, cutting
from gbspec.training.problem import Parameters, Problem


@dataclass(frozen=True)
class Unrolled:
    """States `before` and `after` the arrivals at each key row [R, n_states], initial states `initial` [N, n_states],
    and the predictions at the key rows, `mean` [R, C]."""

    before: Tensor
    after: Tensor
    initial: Tensor
    mean: Tensor


def unroll(
    problem: Problem, parameters: Parameters, theta: Tensor, schedule: Schedule, whole: bool = False
) -> Unrolled:
    """Steps every trajectory from its initial state through its key rows; differentiable in `theta`, which must have
    the schedule's device and type. `whole`: nothing is recomputed in the backward pass, whatever the memory, as where
    `theta` has forward derivatives, which are gone by then."""
    packed, module = problem.packed, problem.module
    networks = module.torch_networks(parameters.weights(theta))
    constants = parameters.constants(theta)
    initial = initial_states(problem, parameters, theta, parameters.starts(theta), constants, networks)
    x = torch.where(schedule.fresh, initial[schedule.owner], schedule.start)
    motion = Motion(problem, schedule, parameters, constants, networks)
    states, late = motion.delayed(schedule, x) if problem.model.delays else (_run(schedule, motion, x, whole), None)
    before = torch.cat(states)[schedule.row]
    value, weight = theta.new_tensor(problem.forcing.value), theta.new_tensor(problem.forcing.weight)
    owner = torch.from_numpy(packed.row_trajectory).to(theta.device)
    seen = None if late is None else torch.cat(late)[schedule.row]
    mean = observe_rows(problem, before, constants[owner], networks, seen)
    return Unrolled(before, before - weight * (before - value), initial, mean)


def _run(schedule: Schedule, motion: Motion, x: Tensor, whole: bool) -> list[Tensor]:
    """States of the live segments at their starts and at the end of each sub-step, from `x` [P, n_states]."""
    passed, steps = [x], schedule.steps
    # Computed in advance, so that an interval that is recomputed uses the same values as the first time.
    flows = {live: motion.of(slice(live)) for live in {len(step.t) for step in steps}}
    events = {live: motion.events(slice(live)) for live in flows}

    def interval(x: Tensor, begin: int, end: int) -> tuple[Tensor, ...]:
        out = []
        for reset, step in zip(schedule.resets[begin:end], steps[begin:end], strict=True):
            if reset is not None:
                given, kept = reset
                x = torch.addcmul(given, kept, x)
            live = len(step.t)
            x = advance(x if live == len(x) else x[:live], step, motion.deliveries, flows[live], events[live])
            out.append(x)
        return tuple(out)

    def single(count: int) -> Tensor:
        """The first segment's first sub-step, as a batch of `count` equal rows."""
        first, row = steps[0], torch.zeros(count, dtype=torch.int64, device=x.device)
        t, h, nodes = first.t[row], first.h[row], tuple(node[row] for node in first.nodes)
        # An event may cut a step anywhere: its memory is that of a few steps, and only its size matters here.
        return advance(x[row], SubStep(t, h, nodes, motion.grid(t, h)), motion.deliveries, motion.of(row))

    every = [(0, len(steps))]
    if torch.is_grad_enabled() and not whole:
        every = memory.checkpoint_intervals([len(step.t) for step in steps], lambda: memory.kept_bytes(single))
    for begin, end in every:
        if len(every) == 1:
            passed += interval(passed[-1], begin, end)
        else:
            passed += checkpoint(interval, passed[-1], begin, end, use_reentrant=False, preserve_rng_state=False)
    return passed


class Motion:
    """Constants [N, n_constants], right-hand side and doses of the segments of a schedule; whatever all segments share
    is computed once."""

    def __init__(
        self, problem: Problem, schedule: Schedule, parameters: Parameters, constants: Tensor, networks: Networks
    ) -> None:
        self._problem, self._networks, self._condition = problem, networks, schedule.condition
        own = {len(problem.model.constants) + i for i in parameters.own}
        # All rows hold the same value of a shared constant: one number replaces them.
        self._constants = [
            column[schedule.owner] if i in own or not len(column) else column[0]
            for i, column in enumerate(constants.unbind(1))
        ]
        self.deliveries = Deliveries.of(problem, schedule.condition, self._constants)
        self._affine: Affine | None = None
        plain = not problem.model.events and not problem.model.delays
        if plain and affine_by_model(parameters.model, problem.module):
            ops = torch_arithmetic(problem.module)
            self._affine = affine(problem.module, ops, schedule.condition, self._constants, networks)

    def of(self, rows: slice | Tensor) -> Field:
        """The right-hand side for some of the segments."""
        if self._affine is not None:
            return self._affine.at(rows)
        k = tuple(value[rows] if value.ndim else value for value in self._constants)
        field: Field = self._problem.module.equations.field(
            torch_arithmetic(self._problem.module), self._condition[rows].unbind(1), k, self._networks
        )
        return field

    def delayed(self, schedule: Schedule, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """States and delayed values of the live segments at their starts and at the end of each sub-step."""
        past = past_of(self._problem, self._condition, self._constants, self._networks, schedule.segments.owner, x)
        flows = {live: self.of(slice(live)) for live in {len(step.t) for step in schedule.steps}}
        steps, resets = schedule.steps, schedule.resets
        return follow(self._problem, steps, resets, past, self.deliveries, flows.__getitem__, x)

    def events(self, rows: slice | Tensor) -> Cutting | None:
        """What cuts the steps of some of the segments; None in models without events."""
        k = tuple(value[rows] if value.ndim else value for value in self._constants)
        return cutting(self._problem, self._condition[rows], k, self._networks, self._networks)

    def grid(self, t: Tensor, h: Tensor) -> Value:
        """The quantities that the solver's step derives from times and lengths [B]."""
        return self._problem.module.equations.grid(torch_arithmetic(self._problem.module), t, h)


def graph_residuals(problem: Problem, mean: Tensor) -> Tensor:
    """Residuals [R, C] of predicted channels [R, C], differentiable in them; 0 where nothing was measured."""
    tables = mean.new_tensor(problem.measured), mean.new_tensor(problem.factor)
    scaling = problem.scaling
    found: Tensor = residuals(mean, *tables, scaling.log, torch, problem.censored, scaling.sizes)
    return found
