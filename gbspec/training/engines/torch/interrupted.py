"""Planning of adaptive steps in models with events, which end just after the first event in them.

So the next step has an error estimate and a Jacobian of its own, after whatever the event has changed. An event lies
inside of its step, and still does at vectors nearby: the step is cut there, whether the path was planned at this
vector or not.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.ir import RosenbrockW
from gbspec.training.engines.torch.control import Walk, rate_slopes, within
from gbspec.training.engines.torch.sub_steps import Divide, cutting, dividing, gamma_of
from gbspec.training.problem import Integers, Parameters, Path, Problem, band_of

AFTER = 1e-9
"""A step ends after the event by this share of the length that was tried."""
PARTS = 5.0
"""Adaptive steps take at most this part of a cell, as the default fixed step does: the error estimate does not see the
conditions of events, which are looked at only at the ends of steps and at one place between."""
FALLING, NEAR, TICKS = 6, 1e5, 1e-5
"""After so many ever shorter intervals between events, the last one of less than so many bands or than this share of
the step, the rest of a cell is one step: whether the events have an end is found out by the solution."""


class InterruptedWalk(Walk):
    """As `Walk`, with the state before what arrived at a step's start, and the intervals between events."""

    factored = False

    def __init__(self, problem: Problem, parameters: Parameters, vector: Tensor, path: Path) -> None:
        super().__init__(problem, parameters, vector, path)
        count = len(self.x)
        self.band, self.prior = band_of(problem), self.x.clone()
        self.event, self.last = np.full(count, -np.inf), np.full(count, np.inf)
        self.falling = np.zeros(count, dtype=np.int64)
        self.gamma = gamma_of(problem) if isinstance(self.method, RosenbrockW) else None

    def _replace(self, rows: Integers) -> None:
        super()._replace(rows)
        self.prior[rows] = self.x[rows]

    def _attempt(self, rows: Integers) -> None:
        packed, who, cell = self.path.packed, self.segments.owner[rows], self.cell[rows]
        start, whole, at = packed.t[cell, who], packed.h[cell, who], self.at[rows]
        given = torch.from_numpy(packed.inputs[cell, who])

        def inputs(after: Array) -> Tensor:
            share = torch.from_numpy(after / np.maximum(whole, 1e-300))[:, None]
            return given[:, 0] + share * (given[:, -1] - given[:, 0])

        x, t, left, rhs = self.x[rows], torch.from_numpy(start + at), whole - at, self.field(rows)
        self._begin(rows, rhs, t, inputs(at), left)
        h = within(self.size[rows] if self.control is None else np.minimum(self.size[rows], whole / PARTS), left)
        jacobians = [x.new_zeros((len(rows), 0, 0))]

        def prepare(x: Tensor, inputs: Callable[[Tensor], Tensor]) -> Divide | None:
            if self.gamma is None:
                return None
            jacobians[:] = [torch.nan_to_num(rate_slopes(rhs, t, x, inputs(t)), nan=0.0)]
            return dividing(jacobians[0], self.gamma)

        events = cutting(self.problem, self.condition[rows], [k[rows] for k in self.k], self.networks, self.networks)
        assert events is not None
        place = torch.from_numpy(packed.start[who]), self._before(rows, inputs(at))
        ends = inputs(at), inputs(at + h)
        begun, wait, signal = events.ahead(t, torch.from_numpy(h), x, ends, *place, prepare)
        found, event = np.isfinite(wait.numpy()), np.minimum(wait.numpy(), h)
        endless = found & self._endless(rows, start + at + event, h)
        taken = np.where(endless, left, self._taken(event, h, left, found))
        divide = None if self.gamma is None else dividing(jacobians[0], self.gamma)
        ends = inputs(at), inputs(at + taken)
        after = events.across(t, torch.from_numpy(taken), x, ends, *place, divide)
        solve = (lambda b: b) if divide is None else divide(torch.from_numpy(event))
        error = self._stages(rhs, begun, t, event, lambda c: signal(t + torch.from_numpy(c * event)), solve)[1]
        ratio = np.where(endless, 0.0, self._ratio(begun, after, error))
        self._pass(rows[found & (ratio <= 1)], (start + at + event)[found & (ratio <= 1)])
        none = np.zeros((len(rows), 0))
        self._decide(rows, taken, ratio, taken >= left * (1 - 1e-12), after, (jacobians[0].numpy(), none))

    def _before(self, rows: Integers, inputs: Tensor) -> tuple[Tensor, Tensor] | None:
        """States and inputs before what arrived at the starts of steps; None where nothing arrives."""
        if not self.problem.model.inputs and not len(self.path.doses):
            return None
        packed, who, cell = self.path.packed, self.segments.owner[rows], self.cell[rows]
        first = torch.from_numpy(self.at[rows] == 0)[:, None]
        earlier = torch.from_numpy(packed.inputs[np.maximum(cell - 1, 0), who, -1])
        enters = first & torch.from_numpy(cell > 0)[:, None]
        return torch.where(first, self.prior[rows], self.x[rows]), torch.where(enters, earlier, inputs)

    def _taken(self, event: Array, h: Array, left: Array, found: Mask) -> Array:
        """The lengths of steps: to just after the events, unless little is left of a cell then."""
        after = np.maximum(4 * self.band, AFTER * h)
        size = np.where(found, event + after, h)
        return np.where(found & (left - size < after), left, size)

    def _endless(self, rows: Integers, event: Array, h: Array) -> Mask:
        """Where intervals between events, the last of which ends at these times, may have no end."""
        interval = event - self.event[rows]
        near = interval <= np.maximum(NEAR * self.band, TICKS * h)
        return np.asarray((self.falling[rows] > FALLING) & (interval < 0.99 * self.last[rows]) & near)

    def _pass(self, rows: Integers, event: Array) -> None:
        """Keeps the intervals between events."""
        interval = event - self.event[rows]
        self.falling[rows] = np.where(interval < 0.99 * self.last[rows], self.falling[rows] + 1, 0)
        self.event[rows], self.last[rows] = event, interval
