"""Sub-steps of a batch as tensors, and their execution: the doses at the start, then a step of the solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from gbspec.backends import Networks, Value
from gbspec.ir import METHODS, RosenbrockW
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.engines.deliveries import Terms, terms_of
from gbspec.training.engines.torch.affine import Field
from gbspec.training.problem import Integers, Path, Problem, band_of


@dataclass(frozen=True)
class SubStep:
    """A sub-step of each of B rows: start `t` and length `h` [B], the inputs at the method's nodes, [B, n_inputs] each,
    and the result of the generated `grid` for `t` and `h`. `arrivals`: the doses, None if there are none; `factors`:
    the frozen matrices [B, n, n] and their pivots [B, n], as in `Factors`; `origin`: the starts of the trajectories
    [B], and `before`: the inputs before the sub-step [B, n_inputs], in models with events."""

    t: Tensor
    h: Tensor
    nodes: tuple[Tensor, ...]
    grid: Value
    arrivals: Arrivals | None = None
    factors: tuple[Tensor, Tensor] | None = None
    origin: Tensor | None = None
    before: Tensor | None = None


@dataclass(frozen=True)
class Arrivals:
    """Doses of a sub-step of B rows, by their numbers in the packing (-1: none): those that arrive at its start
    [L, B], ordered by time, and those whose lags determine its start and its end [B]; the inputs' slopes
    [B, n_inputs]."""

    doses: Integers
    begin: Integers
    end: Integers
    slope: Tensor


def sub_step(problem: Problem, path: Path, steps: Integers, who: Integers, like: Tensor) -> SubStep:
    """The sub-steps with the numbers `steps` [B] of the trajectories `who` [B], as tensors like `like`."""
    packed = path.packed
    t, h, inputs = (like.new_tensor(table[steps, who]) for table in (packed.t, packed.h, packed.inputs))
    arrivals = None
    if len(path.doses):
        doses = path.doses[:, steps, who]
        begin, end = path.cutting[steps, who], path.cutting[steps + 1, who]
        if (doses >= 0).any() or (end >= 0).any():
            slope = path.slope[steps, who] if path.cuts.any() else np.zeros((len(steps), packed.inputs.shape[3]))
            arrivals = Arrivals(doses, begin, end, like.new_tensor(slope))
    grid = problem.module.equations.grid(torch_arithmetic(problem.module), t, h)
    factors = None
    if path.factors is not None:
        pivots = torch.from_numpy(path.factors.pivots[steps, who]).to(like.device)
        factors = like.new_tensor(path.factors.lu[steps, who]), pivots
    origin = before = None
    if problem.model.events:
        origin = like.new_tensor(packed.start[who])
        at_end = like.new_tensor(packed.inputs[np.maximum(steps - 1, 0), who, -1])
        before = torch.where(torch.from_numpy(steps > 0).to(like.device)[:, None], at_end, inputs[:, 0])
    return SubStep(t, h, inputs.unbind(1), grid, arrivals, factors, origin, before)


@dataclass(frozen=True)
class Deliveries:
    """Fraction and lag of each of the model's doses for B rows, with their derivatives."""

    problem: Problem
    terms: Terms

    @classmethod
    def of(cls, problem: Problem, condition: Tensor, k: Sequence[Tensor]) -> Deliveries:
        """The terms for rows with these conditions [B, n_conditions] and constants ([B] or [] each)."""
        return cls(problem, terms_of(problem, condition, k) if problem.model.doses or problem.model.delays else [])

    def added(self, x: Tensor, arrivals: Arrivals) -> Tensor:
        """The states [B, n_states] after the doses at the start of a sub-step."""
        doses, model = self.problem.packed.doses, self.problem.model
        places = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
        for layer in arrivals.doses:
            for kind, (fraction, _) in enumerate(self.terms[: len(model.doses)]):
                mine = (layer >= 0) & (doses.kind[layer] == kind)
                if mine.any():
                    amount = x.new_tensor(np.where(mine, doses.amount[layer], 0.0)) * _rows(fraction, len(x))
                    x = x + amount[:, None] * places[model.state_index[model.doses[kind].state]]
        return x

    def moved(self, step: SubStep, arrivals: Arrivals) -> tuple[Value, tuple[Tensor, ...]]:
        """The grid and the inputs at the nodes of a sub-step whose ends depend on learned lags.

        The displacements added to the ends are zero; they carry the derivatives.
        """
        begin, end = (self._move(edge, step.t) for edge in (arrivals.begin, arrivals.end))
        module = self.problem.module
        grid = module.equations.grid(torch_arithmetic(module), step.t + begin, step.h + (end - begin))
        if not step.nodes[0].shape[1]:
            return grid, step.nodes
        shares = [begin + node * (end - begin) for node in self.problem.packed.nodes]
        moved = zip(step.nodes, shares, strict=True)
        return grid, tuple(node + share[:, None] * arrivals.slope for node, share in moved)

    def ends(self, step: SubStep) -> tuple[Tensor, Tensor]:
        """Start and length of a sub-step, with the derivatives of learned lags."""
        if step.arrivals is None:
            return step.t, step.h
        begin, end = (self._move(edge, step.t) for edge in (step.arrivals.begin, step.arrivals.end))
        return step.t + begin, step.h + (end - begin)

    def _move(self, cutting: Integers, like: Tensor) -> Tensor:
        """The displacement of an end of a sub-step by the doses `cutting` [B]: zero, with the lag's derivative."""
        out, kinds = torch.zeros_like(like), self.problem.packed.doses.kind
        for kind, (_, lag) in enumerate(self.terms):
            mine = (cutting >= 0) & (kinds[cutting] == kind)
            if mine.any() and isinstance(lag, Tensor):
                move = _rows(lag - lag.detach(), len(like))
                out = out + torch.where(torch.from_numpy(mine).to(like.device), move, torch.zeros_like(like))
        return out


def _rows(value: Tensor | float, count: int) -> Tensor | float:
    """The first rows of a term; a number is the same for all rows."""
    return value[:count] if isinstance(value, Tensor) and value.ndim else value


def advance(x: Tensor, step: SubStep, deliveries: Deliveries, rhs: Field, events: Cutting | None = None) -> Tensor:
    """The states [B, n_states] at the end of a sub-step, from those at its start before doses; `events` cut it."""
    problem, grid, nodes, before = deliveries.problem, step.grid, step.nodes, x
    if step.arrivals is not None:
        x = deliveries.added(x, step.arrivals)
        if (step.arrivals.begin >= 0).any() or (step.arrivals.end >= 0).any():
            grid, nodes = deliveries.moved(step, step.arrivals)
    if events is not None:
        t, h = deliveries.ends(step)
        arriving = bool(problem.model.inputs) or step.arrivals is not None
        divide = None if step.factors is None else dividing(step.factors[0], gamma_of(problem))
        return events.across(t, h, x, nodes, step.origin, (before, step.before) if arriving else None, divide)
    solve = () if step.factors is None else (solver_of(*step.factors),)
    out: Tensor = problem.module.equations.step(torch_arithmetic(problem.module), rhs, grid, x, nodes, *solve)
    return out


Divide = Callable[[Tensor], Callable[[Tensor], Tensor]]
"""The division of vectors [B, n] by the matrices of steps of some sizes [B]."""
Prepare = Callable[[Tensor, Callable[[Tensor], Tensor]], Divide | None]
"""The division for steps from states [B, n], with inputs at a time."""


class Cutting(Protocol):
    """The module's own steps that are cut where events happen (`_Events` of its template)."""

    trouble: str

    def across(
        self, t: Tensor, h: Tensor, x: Tensor, u: Value, origin: Value, before: Value, divide: Divide | None
    ) -> Tensor:
        """The states after a step."""

    def ahead(
        self, t: Tensor, h: Tensor, x: Tensor, u: Value, origin: Value, before: Value, prepare: Prepare
    ) -> tuple[Tensor, Tensor, Callable[[Tensor], Tensor]]:
        """The states after events at the start, the times until the next ones, and the inputs at a time."""


def cutting(
    problem: Problem, condition: Value, k: Sequence[Tensor], networks: Networks, quiet: Networks
) -> Cutting | None:
    """The events of B rows; None in models without. `quiet` are networks that record nothing."""
    if not problem.model.events:
        return None
    given, found = (condition, tuple(k), networks), tuple(value.detach() for value in k)
    made: Cutting = problem.module.equations.cutting(given, (condition, found, quiet), band_of(problem), False)
    return made


def gamma_of(problem: Problem) -> float:
    """The diagonal coefficient of the problem's method, which has matrices."""
    method = METHODS[problem.module.solver]
    assert isinstance(method, RosenbrockW)
    return float(method.gamma)


def dividing(slopes: Tensor, gamma: float) -> Divide:
    """The division by I - gamma h W for steps of sizes h, with the Jacobians W [B, n, n] as constants. Derivatives by
    the sizes are those of what is computed."""
    unit = torch.eye(slopes.shape[-1], dtype=slopes.dtype, device=slopes.device)

    def divide(size: Tensor) -> Callable[[Tensor], Tensor]:
        matrix = torch.nan_to_num(unit - gamma * size[:, None, None] * slopes, nan=1.0)
        lu, pivots, _ = torch.linalg.lu_factor_ex(matrix)
        return solver_of(lu, pivots)

    return divide


def solver_of(lu: Tensor, pivots: Tensor) -> Callable[[Tensor], Tensor]:
    """The division of vectors [B, k n], k blocks each, by factored matrices [B, n, n], which are constants in
    derivatives."""

    def divided(b: Tensor) -> Tensor:
        n = lu.shape[-1]
        blocks = b.reshape(*b.shape[:-1], b.shape[-1] // n, n).transpose(-1, -2)
        solved: Tensor = torch.linalg.lu_solve(lu, pivots, blocks)
        return solved.transpose(-1, -2).reshape(b.shape)

    return divided
