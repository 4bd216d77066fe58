"""The exact Jacobian by the torch graph.

One solution gives the state at the start of every interval between consecutive key rows; all intervals are then
recomputed as one batch, sorted by length, whose live prefix shrinks. One backward pass per state gives cotangents of
the networks' pre-activations, of the states at the starts and of the constants; an interval's derivatives by weights
are a batched product of these cotangents with the layers' inputs. Then the intervals of each trajectory are chained
(see `columns`). Cost: one forward and n_states backward passes, whatever the number of measured values.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.engines.columns import Columns, Taped, gradients
from gbspec.training.engines.engine import Moments
from gbspec.training.engines.linearised import Batch, Jacobian, Observed
from gbspec.training.engines.torch.sub_steps import Deliveries, advance, cutting, sub_step
from gbspec.training.problem import Integers, Path

CHUNK_BYTES = 256 * 1024 * 1024
"""Approximate size of the chunks in which derivatives of intervals by weights are computed."""


def jacobian(columns: Columns, path: Path, moments: Moments, observed: Observed) -> Jacobian:
    """Derivatives of the measured values, on the columns' device."""
    packed, parameters = path.packed, columns.parameters
    total_shared, total_local = columns.initial(torch.arange(packed.trajectories, device=columns.device))
    # Filled in place: for large data sets this is by far the largest array, and it is allocated only once.
    shared = columns.zeros((len(observed.row), columns.shared))
    local = columns.zeros((len(observed.row), parameters.n_local))
    release = columns.tensor(1.0 - columns.problem.forcing.weight)[:, :, None]
    owner = columns.tensor(packed.row_trajectory)
    position = 0
    for a, j_shared, j_local in _Intervals(columns, path, moments).by_place():
        # Each item covers the rows that share one place within their trajectories.
        rows = slice(position, position + len(a))
        position += len(a)
        who = owner[rows]
        s_shared = torch.baddbmm(j_shared, a, total_shared[who]) if columns.shared else j_shared
        s_local = torch.baddbmm(j_local, a, total_local[who])
        part = observed.of_rows(rows)
        shared[part] = observed.apply_shared(rows, s_shared)
        local[part] = observed.apply_local(rows, s_local)
        total_shared[who] = s_shared * release[rows]
        total_local[who] = s_local * release[rows]
    return Jacobian(columns.of_trained_weights(shared), local, owner[observed.row])


class _Intervals:
    """The derivatives of the intervals that end at key rows: A [B, n, n] and J (shared, local) [B, n, columns]."""

    def __init__(self, columns: Columns, path: Path, moments: Moments) -> None:
        self.columns, self.path = columns, path
        self.after, self.initial = columns.tensor(moments.after), columns.tensor(moments.initial)

    def by_place(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """For each place k, the derivatives of the intervals that end at the k-th rows of trajectories."""
        packed, columns = self.path.packed, self.columns
        places = np.searchsorted(packed.row_index, np.arange(int(packed.row_index.max(initial=-1)) + 2))
        per_row = 8 * columns.n_states * max(columns.shared, 1)
        begin = 0
        while begin < len(places) - 1:
            end = begin + 1
            while end < len(places) - 1 and (places[end + 1] - places[begin]) * per_row <= CHUNK_BYTES:
                end += 1
            a, shared, local = self._of_rows(np.arange(places[begin], places[end]))
            for k in range(begin, end):
                part = slice(int(places[k] - places[begin]), int(places[k + 1] - places[begin]))
                yield a[part], shared[part], local[part]
            begin = end

    def _of_rows(self, rows: Integers) -> tuple[Tensor, Tensor, Tensor]:
        """A and J of the intervals that end at the given rows, in their order."""
        packed, columns, n = self.path.packed, self.columns, self.columns.n_states
        first, start = self._starts(rows)
        length = packed.row_step[rows] - first
        order = np.argsort(-length, kind="stable")
        batch = Batch(packed.row_trajectory[rows][order], first[order], length[order])
        owner = columns.tensor(batch.owner)
        x = start[columns.tensor(order)].requires_grad_()
        k = [column.detach().clone().requires_grad_() for column in columns.constants[owner].unbind(1)]
        tape: Taped = []
        end, calls = self._propagate(batch, x, k, tape)
        shared = columns.zeros((len(rows), n, columns.shared))
        local = columns.zeros((len(rows), n, columns.parameters.n_local))
        a = columns.zeros((len(rows), n, n))
        weights_wanted = bool(tape) and not columns.only_local
        pre = [z for *_, z in tape] if weights_wanted else []
        activations = self._activations(tape, calls, batch) if weights_wanted else {}
        for i in range(n):
            grads = gradients(end[:, i].sum(), [x, *k, *pre])
            a[:, i] = grads[0]
            by_constants = [g[:, None] for g in grads[1 : 1 + len(k)]]
            columns.add_constants(shared[:, i : i + 1], local[:, i : i + 1], by_constants, owner)
            if weights_wanted:
                self._contract(shared[:, i], tape, grads[1 + len(k) :], activations, calls, batch)
        back = columns.tensor(np.argsort(order, kind="stable"))
        return a[back], shared[back], local[back]

    def _starts(self, rows: Integers) -> tuple[Integers, Tensor]:
        """The sub-step at which the interval that ends at each row begins, and the state there."""
        packed, tensor = self.path.packed, self.columns.tensor
        fresh = packed.row_index[rows] == 0
        start = self.after[tensor(packed.previous_row[rows])].clone()
        start[tensor(fresh)] = self.initial[tensor(packed.row_trajectory[rows][fresh])]
        return packed.first_step[rows], start

    def _propagate(self, batch: Batch, x: Tensor, k: list[Tensor], tape: Taped) -> tuple[Tensor, list[int]]:
        """Steps the batch to the ends of its rows; the first j sub-steps wrote `calls[j]` tape entries."""
        columns, problem = self.columns, self.columns.problem
        networks = problem.module.torch_networks(columns.weights, tape)
        quiet = problem.module.torch_networks(columns.weights) if problem.model.events else networks
        condition = columns.tensor(self.path.packed.condition[batch.owner])
        deliveries = Deliveries.of(problem, condition, k)
        finished: list[Tensor] = [x[batch.live(0) :]]
        state = x[: batch.live(0)]
        calls = [0]
        for j in range(batch.depth):
            live = batch.live(j)
            step = sub_step(problem, self.path, batch.first[:live] + j, batch.owner[:live], x.detach())
            rhs = problem.module.equations.field(
                torch_arithmetic(problem.module), condition[:live], tuple(column[:live] for column in k), networks
            )
            part = [column[:live] for column in k]
            events = cutting(problem, condition[:live], part, networks, quiet)
            state = advance(state, step, deliveries, rhs, events)
            calls.append(len(tape))
            remaining = batch.live(j + 1)
            finished.append(state[remaining:])
            state = state[:remaining]
        return torch.cat(finished[::-1]), calls

    def _activations(self, tape: Taped, calls: list[int], batch: Batch) -> dict[tuple[int, int, int], Tensor]:
        """Inputs of each layer by (network, layer, group): [B, Q, width] over sub-steps, their Runge-Kutta stages, and
        elements of arrays."""
        out: dict[tuple[int, int, int], Tensor] = {}
        for group, (length, begin, end) in enumerate(batch.groups):
            for network, layer in self.columns.offsets:
                parts = [a.detach()[begin:end] for *key, a, _ in tape[: calls[length]] if key == [network, layer]]
                if parts:
                    out[network, layer, group] = _joined(parts)
        return out

    def _contract(
        self,
        target: Tensor,
        tape: Taped,
        cotangents: list[Tensor],
        activations: dict[tuple[int, int, int], Tensor],
        calls: list[int],
        batch: Batch,
    ) -> None:
        """Writes the weights' columns [B, columns] of one state: the sum over sub-steps and Runge-Kutta stages of the
        outer products of cotangents and layers' inputs."""
        for group, (length, begin, end) in enumerate(batch.groups):
            entries = list(zip(tape[: calls[length]], cotangents[: calls[length]], strict=True))
            for (network, layer), (offset, rows, width) in self.columns.offsets.items():
                parts = [dz[begin:end] for (*key, _, _), dz in entries if key == [network, layer]]
                if not parts:
                    continue
                dz = _joined(parts)
                product = torch.bmm(dz.transpose(1, 2), activations[network, layer, group])
                target[begin:end, offset : offset + rows * width] = product.reshape(end - begin, -1)
                target[begin:end, offset + rows * width : offset + rows * width + rows] = dz.sum(1)


def _joined(parts: list[Tensor]) -> Tensor:
    """Points [B, ..., width] of several calls as one [B, Q, width]; calls for whole arrays have an axis of elements."""
    return torch.cat([part.reshape(len(part), -1, part.shape[-1]) for part in parts], 1)
