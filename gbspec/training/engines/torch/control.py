"""Planning of adaptive steps and of frozen matrices: one solution at a vector, in which every step is tried.

All segments (see `segments`) are solved side by side, each with steps of its own: in a pass, every segment that is not
at its end tries one step, and keeps it if its error estimate is within the tolerance. Without `control` each cell is
one step, and only the matrices are computed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.ir import METHODS, Explicit, RosenbrockW
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.engines.starting import initial_states
from gbspec.training.engines.torch.affine import Field
from gbspec.training.engines.torch.segments import cut
from gbspec.training.engines.torch.sub_steps import Arrivals, Deliveries, solver_of
from gbspec.training.problem import MOST_STEPS, Integers, Parameters, Path, Problem, Steps

SAFETY, SHRINK, GROW = 0.9, 0.2, 5.0
"""The share of the step that the error estimate allows which is tried next, and the limits of a step's change."""
FIRST = 1e-2
"""The first step of a segment moves its state by this share of its size, unless the cell is shorter."""
LEAST = 1e-14
"""A step shorter than this share of the time reached ends the solution."""


class Walk:
    """P segments on their way: the cell that each is in, the time since its start, and the next step."""

    factored = True
    """Whether matrices are kept with their factors."""

    def __init__(self, problem: Problem, parameters: Parameters, vector: Tensor, path: Path) -> None:
        self.problem, self.path, self.method = problem, path, METHODS[problem.module.solver]
        self.control, self.ops = problem.control, torch_arithmetic(problem.module)
        self.segments = segments = cut(path.packed, problem.forcing.weight)
        self.networks = problem.module.torch_networks(parameters.weights(vector))
        constants = parameters.constants(vector)
        self.condition = torch.from_numpy(path.packed.condition)[segments.owner]
        self.k = tuple(constants[segments.owner].unbind(1))
        x0 = parameters.starts(vector)
        initial = initial_states(problem, parameters, vector, x0, constants, self.networks)
        self.x = initial[segments.owner].clone()
        later = segments.start >= 0
        self.x[later] = torch.from_numpy(problem.forcing.value[segments.start[later]])
        self.floor = None if self.control is None else torch.from_numpy(self.control.floor)
        count, n = len(segments.owner), self.x.shape[1]
        self.cell, self.at, self.size = segments.first.copy(), np.zeros(count), np.full(count, np.nan)
        self.error, self.taken = np.ones(count), np.zeros(count, dtype=np.int64)
        self.entering, self.going = np.ones(count, dtype=bool), segments.length > 0
        self.slopes, self.known = self.x.new_zeros((count, n, n)), np.zeros(count, dtype=bool)
        self.steps: list[Steps] = []
        inside = segments.row_step < segments.length[segments.row_segment] if count else np.zeros(0, dtype=bool)
        rows = np.flatnonzero(inside)
        self.reset = np.full((count, segments.depth + 1), -1, dtype=np.int64)
        self.reset[segments.row_segment[rows], segments.row_step[rows]] = rows

    def run(self) -> Steps:
        """The accepted steps of all segments."""
        n = self.x.shape[1] if isinstance(self.method, RosenbrockW) else 0
        none = np.zeros(0, dtype=np.int64)
        empty = np.zeros((0, n if self.factored else 0), dtype=np.int32)
        self.steps = [Steps(none, none, np.zeros(0), np.zeros(0), np.zeros((0, n, n)), empty)]
        while self.going.any():
            rows = np.flatnonzero(self.going)
            self._enter(rows[self.entering[rows]])
            self._attempt(rows)
        return Steps.joined(self.steps)

    def field(self, rows: Integers) -> Field:
        """The right-hand side of some of the segments."""
        k = tuple(column[rows] for column in self.k)
        found: Field = self.problem.module.equations.field(self.ops, self.condition[rows], k, self.networks)
        return found

    def _enter(self, rows: Integers) -> None:
        """What happens at the start of a cell: resets, then doses."""
        if not len(rows):
            return
        self._replace(rows)
        doses = self.path.doses
        if len(doses):
            k = [column[rows] for column in self.k]
            here = Deliveries.of(self.problem, self.condition[rows], k)
            none = np.full(len(rows), -1, dtype=np.int64)
            arriving = Arrivals(doses[:, self.cell[rows], self.segments.owner[rows]], none, none, self.x.new_zeros(0))
            self.x[rows] = here.added(self.x[rows], arriving)
        self.entering[rows] = self.known[rows] = False

    def _replace(self, rows: Integers) -> None:
        """Resets at the start of a cell."""
        forcing = self.problem.forcing
        key = self.reset[rows, self.cell[rows] - self.segments.first[rows]]
        reset = rows[key >= 0]
        if len(reset):
            value, weight = (torch.from_numpy(table[key[key >= 0]]) for table in (forcing.value, forcing.weight))
            self.x[reset] = self.x[reset] - weight * (self.x[reset] - value)

    # ---------------------------------------------------------------- one step
    def _attempt(self, rows: Integers) -> None:
        """Tries one step of each of some segments."""
        packed, who, cell = self.path.packed, self.segments.owner[rows], self.cell[rows]
        start, whole, x = packed.t[cell, who], packed.h[cell, who], self.x[rows]
        rhs, t = self.field(rows), torch.from_numpy(start + self.at[rows])
        given = torch.from_numpy(packed.inputs[cell, who])

        def inputs(after: Array) -> Tensor:
            share = torch.from_numpy(after / np.maximum(whole, 1e-300))[:, None]
            return given[:, 0] + share * (given[:, -1] - given[:, 0])

        left = whole - self.at[rows]
        self._begin(rows, rhs, t, inputs(self.at[rows]), left)
        h = within(self.size[rows], left)
        lu, pivots = self._factored(rows, rhs, t, inputs(self.at[rows]), h)
        after, error = self._stages(rhs, x, t, h, lambda c: inputs(self.at[rows] + c * h), solver_of(lu, pivots))
        ratio = self._ratio(x, after, error)
        last = h >= left * (1 - 1e-12)
        self._decide(rows, h, ratio, last, after, (lu.numpy(), pivots.numpy()))

    def _begin(self, rows: Integers, rhs: Field, t: Tensor, u: Tensor, left: Array) -> None:
        """First steps of segments that have none."""
        if self.control is None or self.floor is None:
            self.size[rows] = left
            return
        new = np.isnan(self.size[rows])
        if new.any():
            x = self.x[rows]
            rate = (rhs(t, x, u).abs() / (x.abs() + self.floor)).amax(1).numpy()
            usable = np.where(np.isfinite(rate), np.maximum(rate, 1e-300), 1e300)
            self.size[rows[new]] = np.minimum(left, FIRST / usable)[new]

    def _factored(self, rows: Integers, rhs: Field, t: Tensor, u: Tensor, h: Array) -> tuple[Tensor, Tensor]:
        """The factored matrices of steps."""
        if not isinstance(self.method, RosenbrockW):
            return torch.zeros((len(rows), 0, 0)), torch.zeros((len(rows), 0), dtype=torch.int32)
        if not self.known[rows].all():
            self.slopes[rows], self.known[rows] = rate_slopes(rhs, t, self.x[rows], u), True
        scaled = torch.from_numpy(float(self.method.gamma) * h)[:, None, None] * self.slopes[rows]
        matrix = torch.eye(scaled.shape[1], dtype=scaled.dtype) - scaled
        lu, pivots, _ = torch.linalg.lu_factor_ex(torch.nan_to_num(matrix, nan=1.0))
        return lu, pivots

    def _stages(
        self,
        rhs: Field,
        x: Tensor,
        t: Tensor,
        h: Array,
        inputs: Callable[[float], Tensor],
        solve: Callable[[Tensor], Tensor],
    ) -> tuple[Tensor, Tensor]:
        """The states after steps, and their estimated errors."""
        method, size = self.method, torch.from_numpy(h)[:, None]
        ks: list[Tensor] = []
        for i, (row, c) in enumerate(zip(method.a, map(float, method.c), strict=True)):
            at = x + size * _sum(row, ks) if any(row) else x
            rate = rhs(t + torch.from_numpy(c * h), at, inputs(c))
            if isinstance(method, Explicit):
                ks.append(rate)
            else:
                v = _sum(method.coupling[i], ks) if any(method.coupling[i]) else torch.zeros_like(x)
                ks.append(solve(rate + v) - v)
        error = size * _sum(method.b_error, ks) if method.b_error else torch.zeros_like(x)
        return x + size * _sum(method.b, ks), error

    def _ratio(self, x: Tensor, after: Tensor, error: Tensor) -> Array:
        """The error of each step in units of the tolerance; infinite where it is not a number."""
        if self.control is None or self.floor is None:
            return np.zeros(len(x))
        limit = self.control.rtol * (torch.maximum(x.abs(), after.abs()) + self.floor)
        ratio = (error.abs() / limit).amax(1).numpy()
        return np.where(np.isfinite(ratio) & torch.isfinite(after).all(1).numpy(), ratio, np.inf)

    # ---------------------------------------------------------------- control
    def _decide(
        self, rows: Integers, h: Array, ratio: Array, last: Mask, after: Tensor, factors: tuple[Array, Array]
    ) -> None:
        """Keeps the steps whose error is small enough, and chooses the next ones."""
        good = ratio <= 1
        kept = rows[good]
        lu, pivots = (part[good] for part in factors)
        owner, cell, length = self.segments.owner[kept], self.cell[kept], h[good]
        # A cell's last step ends where the cell ends, not within rounding of it.
        self.steps.append(Steps(owner, cell.copy(), self.at[kept], length, lu, pivots.astype(np.int32)))
        self.x[kept], self.known[kept] = after[good], False
        self.at[kept] += length
        self.taken[rows] += 1
        through = rows[good & last]
        self.cell[through] += 1
        self.at[through], self.entering[through] = 0.0, True
        self.going[through] = self.cell[through] < self.segments.first[through] + self.segments.length[through]
        if self.control is not None:
            self.size[rows] = next_size(self.size[rows], h, ratio, self.error[rows], self._order)
            self.error[kept] = np.maximum(ratio[good], 1e-4)
            self._give_up(rows)

    @property
    def _order(self) -> int:
        return (self.method.embedded_order or 0) + 1

    def _give_up(self, rows: Integers) -> None:
        """Ends segments whose steps have become too short or too many: from here on they have no solution."""
        rows = rows[self.going[rows]]
        time = np.abs(self.path.packed.t[self.cell[rows], self.segments.owner[rows]]) + self.at[rows]
        short = (self.size[rows] <= LEAST * time) | (self.size[rows] < 1e-250)
        lost = rows[short | (self.taken[rows] > MOST_STEPS)]
        if not len(lost):
            return
        self.going[lost] = False
        owner, count = self.segments.owner[lost], len(lost)
        n = self.x.shape[1] if isinstance(self.method, RosenbrockW) else 0
        lu = np.broadcast_to(np.eye(n), (count, n, n))
        exchanged = n if self.factored else 0
        pivots = np.broadcast_to(np.arange(1, exchanged + 1, dtype=np.int32), (count, exchanged))
        self.steps.append(Steps(owner, self.cell[lost].copy(), self.at[lost], np.full(count, np.nan), lu, pivots))


def next_size(before: Array, h: Array, ratio: Array, last: Array, order: int) -> Array:
    """The next steps, by the errors of this one and of the one before it (PI control); a rejected step only shrinks."""
    with np.errstate(divide="ignore", over="ignore"):
        safe = np.clip(ratio, 1e-10, 1e10)
        steady = SAFETY * safe ** (-0.7 / order) * last ** (0.4 / order)
        alone = SAFETY * safe ** (-1.0 / order)
    factor = np.where(ratio <= 1, np.clip(steady, SHRINK, GROW), np.clip(alone, SHRINK, SAFETY))
    # A step that was cut by the end of its cell says nothing against the longer one that was wanted.
    return np.asarray(np.where(ratio <= 1, np.maximum(h * factor, np.where(h < before, before, 0.0)), h * factor))


def within(size: Array, left: Array) -> Array:
    """The steps that are taken: at most what is left of the cell, in two equal parts if it is less than two steps."""
    return np.where(size >= left * (1 - 1e-9), left, np.where(size > 0.5 * left, 0.5 * left, size))


def _sum(weights: Sequence[Fraction], ks: list[Tensor]) -> Tensor:
    """A weighted sum of rates; at least one weight is not zero."""
    total: Tensor | None = None
    for weight, k in zip(weights, ks, strict=False):
        if weight:
            total = float(weight) * k if total is None else torch.add(total, k, alpha=float(weight))
    assert total is not None
    return total


def rate_slopes(rhs: Field, t: Tensor, x: Tensor, u: Tensor) -> Tensor:
    """The Jacobian of right-hand sides with respect to states [B, n, n]."""
    with torch.enable_grad():
        at = x.detach().requires_grad_()
        rates = rhs(t, at, u) + 0.0 * at
        rows = [torch.autograd.grad(rate.sum(), at, retain_graph=True)[0] for rate in rates.unbind(-1)]
    return torch.stack(rows, -2)
