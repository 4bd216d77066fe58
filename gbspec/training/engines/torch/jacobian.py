"""The exact Jacobian of all residuals with respect to everything that is trained.

Segments are the stretches between consecutive key rows of a trajectory. One solution gives every segment's start, so
all segments are recomputed as one batch, sorted by length, whose live prefix shrinks. Cotangents of the networks'
pre-activations, of the starts and of the constants come from one backward pass for each state; the weights' part of
a segment's Jacobian is a batched product of these cotangents with the layers' inputs. Then a state-sized recursion
chains the segments of each trajectory: with A = d end / d start and J = d end / d parameters of a segment, the
sensitivity S of the state becomes `A S + J` on arrival; resets by forcing scale its rows by `1 - weight`.
Cost: one forward and n_states backward passes, whatever the number of residuals.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gbspec.data.trajectories import Array
from gbspec.training.engines.linearised import Batch, Linearised, Observed
from gbspec.training.engines.torch.doses import SubStep, advance, arrivals
from gbspec.training.engines.torch.unroll import Unrolled, measured_residuals, observe_rows, residuals_of, unroll
from gbspec.training.problem.bounds import STRETCH
from gbspec.training.problem.packing import Integers
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem

if TYPE_CHECKING:
    from gbspec.training.engines.native.kernel import Kernel

Taped = list[tuple[int, int, Tensor, Tensor]]

CHUNK_BYTES = 256 * 1024 * 1024
"""Segments' weight Jacobians are formed in chunks of about this size."""


def linearise(problem: Problem, parameters: Parameters, theta: Array, only_local: bool = False) -> Linearised:
    """Residuals and exact Jacobian at `theta`; with `only_local` the columns of the shared part stay empty.

    The residuals may hold NaN or infinities where the solution blew up; the caller decides what that means.
    """
    vector = torch.from_numpy(theta)
    with torch.no_grad():
        solution = unroll(problem, parameters, vector)
    if not bool(torch.isfinite(solution.residuals).all() and torch.isfinite(solution.arrival).all()):
        empty = torch.zeros((0, 0), dtype=vector.dtype)
        return Linearised(
            measured_residuals(problem, solution.residuals), empty, empty, torch.zeros(0, dtype=torch.int64)
        )
    found = _Sweep(problem, parameters, theta, solution, only_local).run()
    return Linearised(found.residuals, found.shared.cpu(), found.local.cpu(), found.owner.cpu())


class _Sweep:
    """One computation of the Jacobian: holds what its steps share."""

    def __init__(
        self, problem: Problem, parameters: Parameters, theta: Array, solution: Unrolled, only_local: bool
    ) -> None:
        self.problem, self.parameters, self.only_local = problem, parameters, only_local
        self.device, self.theta, self.vector = problem.device, theta, torch.from_numpy(theta).to(problem.device)
        self.residuals = measured_residuals(problem, solution.residuals)
        self.arrival, self.departure, self.initial = (
            part.to(self.device) for part in (solution.arrival, solution.departure, solution.initial)
        )
        with torch.no_grad():
            self.weights = {name: value.detach().clone() for name, value in parameters.weights(self.vector).items()}
            self.constants = parameters.constants(self.vector)
        for name in parameters.weight_shapes:
            # Only so that every pre-activation is part of the graph; the gradients of the weights are never asked for.
            self.weights[name].requires_grad_()
        self.n_states = len(problem.model.states)
        self.shared_columns = 0 if only_local else parameters.n_shared
        self.offsets = _layer_offsets(parameters)

    def _tensor(self, table: NDArray[Any]) -> Tensor:
        return torch.from_numpy(table).to(self.device)

    def _zeros(self, shape: tuple[int, ...]) -> Tensor:
        return torch.zeros(shape, dtype=self.vector.dtype, device=self.device)

    def run(self) -> Linearised:
        """Residuals, and on the device their Jacobian."""
        return self._by_torch() if self.problem.kernel is None else self._by_kernel(self.problem.kernel)

    def _by_kernel(self, kernel: Kernel) -> Linearised:
        """With the intervals' derivatives and their chain from the native kernel."""
        from gbspec.training.engines.native.jacobian import Intervals, chain

        packed, columns = self.problem.packed, self.shared_columns
        observed = self._observations()
        arrays = (self.theta, self.departure.numpy(), self.initial.numpy())
        intervals = Intervals(self.problem, kernel, self.parameters, *arrays)
        # Every row is written once; for much data this is by far the largest array.
        shared = np.empty((len(self.residuals), columns))
        local = np.empty((len(self.residuals), self.parameters.n_local))
        unused = [self._zeros(())] * len(self.problem.model.constants)
        release, d_state = 1.0 - self.problem.forcing.weight, np.ascontiguousarray(observed.state.numpy())
        for who, blocks in intervals.blocks(columns):
            totals = [part.numpy() for part in self._initial(torch.from_numpy(who))]
            for rows in blocks:
                found, owner = intervals.derivatives(rows, columns), packed.row_trajectory[rows]
                own = np.zeros((len(rows), self.n_states, local.shape[1]))
                of_weights, of_own = torch.from_numpy(found.weights), torch.from_numpy(own)
                of_constants = list(torch.from_numpy(found.constants).unbind(2))
                self._add_constants(of_weights, of_own, [*unused, *of_constants], torch.from_numpy(owner))
                places = observed.bounds[rows], observed.bounds[rows + 1]
                for kind, total, out in zip((found.weights, own), totals, (shared, local), strict=True):
                    chain(kernel, owner - who[0], found.start, kind, release[rows], places, d_state, total, out)
        of_shared, of_local = torch.from_numpy(shared), torch.from_numpy(local)
        if observed.shared is not None and observed.local is not None:
            of_shared += self._of_trained_weights(observed.shared)
            of_local += observed.local
        owners = self._tensor(packed.row_trajectory)
        return Linearised(self.residuals, of_shared, of_local, owners[observed.row])

    def _by_torch(self) -> Linearised:
        """With the torch graph, on its device."""
        packed, parameters = self.problem.packed, self.parameters
        observed = self._observations()
        sensitivity_shared, sensitivity_local = self._initial(torch.arange(packed.trajectories, device=self.device))
        # Filled as it goes: for much data this is by far the largest array, and it is made only once.
        shared = self._zeros((len(self.residuals), self.shared_columns))
        local = self._zeros((len(self.residuals), parameters.n_local))
        release = self._tensor(1.0 - self.problem.forcing.weight)[:, :, None]
        owner = self._tensor(packed.row_trajectory)
        position = 0
        for a, j_shared, j_local in self._segments():
            # Each item covers the rows that share one place within their trajectories.
            rows = slice(position, position + len(a))
            position += len(a)
            who = owner[rows]
            s_shared = torch.baddbmm(j_shared, a, sensitivity_shared[who]) if not self.only_local else j_shared
            s_local = torch.baddbmm(j_local, a, sensitivity_local[who])
            part = observed.of_rows(rows)
            shared[part] = observed.apply_shared(rows, s_shared)
            local[part] = observed.apply_local(rows, s_local)
            sensitivity_shared[who] = s_shared * release[rows]
            sensitivity_local[who] = s_local * release[rows]
        return Linearised(self.residuals, self._of_trained_weights(shared), local, owner[observed.row])

    def _of_trained_weights(self, shared: Tensor) -> Tensor:
        """Columns of the weights in use as those of the trained ones (they differ where contracts need signs)."""
        weights = self.parameters.weights(torch.from_numpy(self.theta))
        arrays = {name: value.numpy() for name, value in weights.items()}
        slopes = {} if self.only_local else self.problem.module.weight_slopes(arrays)
        position = 0
        for name, shape in self.parameters.weight_shapes.items():
            size = int(np.prod(shape))
            if name in slopes:
                shared[:, position : position + size] *= self._tensor(slopes[name].ravel())
            position += size
        return shared

    # ---------------------------------------------------------------- starts
    def _initial(self, who: Tensor) -> tuple[Tensor, Tensor]:
        """Sensitivity of the initial states of some trajectories [B, n_states, columns]: shared and local."""
        parameters, n, count = self.parameters, self.n_states, len(who)
        d_start, *d_constants = (part[who] for part in self._start_derivatives)
        shared = self._zeros((count, n, self.shared_columns))
        local = self._zeros((count, n, parameters.n_local))
        scale = self._tensor(parameters.start_free * parameters.start_scale * STRETCH)[who]
        local[:, :, len(parameters.own) :] = d_start * scale[:, None, :]
        self._add_constants(shared, local, d_constants, who)
        return shared, local

    @cached_property
    def _arrivals(self) -> Integers:
        """Which doses arrive in which sub-step: see `arrivals`."""
        return arrivals(self.problem, self.constants)

    @cached_property
    def _start_derivatives(self) -> list[Tensor]:
        """Of the initial states, by what is learned of them [N, n, n] and by each constant [N, n]."""
        problem = self.problem
        x0 = self.parameters.starts(self.vector).detach().requires_grad_()
        k = [column.detach().clone().requires_grad_() for column in self.constants.unbind(1)]
        out = problem.module._initial(problem.ops, x0, self._tensor(problem.packed.condition), tuple(k))
        return _rows_of_jacobian(out, [x0, *k])

    def _add_constants(self, shared: Tensor, local: Tensor, derivatives: list[Tensor], owner: Tensor) -> None:
        """Adds d/d constants (one [B, n] a constant, natural) to the columns of their trainable values."""
        parameters = self.parameters
        known = len(parameters.model.constants)
        if parameters.shared and not self.only_local:
            u = self.theta[parameters.n_weights : parameters.n_shared]
            slope = self._tensor(parameters.bijections(parameters.shared).derivative(u))
            for column, index in enumerate(parameters.shared):
                shared[..., parameters.n_weights + column] += derivatives[known + index] * slope[column]
        if parameters.own:
            u = self.theta[parameters.n_shared :].reshape(-1, parameters.n_local)[:, : len(parameters.own)]
            slope = self._tensor(parameters.bijections(parameters.own).derivative(u))
            for column, index in enumerate(parameters.own):
                local[..., column] += derivatives[known + index] * slope[owner, column][:, None]

    # ---------------------------------------------------------------- observations
    def _observations(self) -> Observed:
        problem, packed = self.problem, self.problem.packed
        seen = np.nonzero(packed.weights > 0)
        row, channel = (self._tensor(places) for places in seen)
        owner = self._tensor(packed.row_trajectory)
        direct = all(c.state is not None for c in problem.model.channels)
        x = self.arrival.detach().requires_grad_()
        tape: Taped = []
        k = [column.detach().clone().requires_grad_() for column in self.constants[owner].unbind(1)]
        networks = problem.module.torch_networks(self.weights, tape)
        constants = torch.stack(k, 1) if k else self._zeros((packed.rows, 0))
        out = residuals_of(problem, observe_rows(problem, x, constants, networks))
        pre = [z for *_, z in tape]
        channels = out.shape[1]
        d_state = self._zeros((packed.rows, channels, self.n_states))
        d_shared = d_local = None
        if not direct:
            d_shared = self._zeros((packed.rows, channels, self.shared_columns))
            d_local = self._zeros((packed.rows, channels, self.parameters.n_local))
        for i in range(channels):
            grads = _gradients(out[:, i].sum(), [x, *k, *pre])
            d_state[:, i] = grads[0]
            if d_shared is None or d_local is None:
                continue
            self._add_constants(
                d_shared[:, i : i + 1], d_local[:, i : i + 1], [g[:, None] for g in grads[1 : 1 + len(k)]], owner
            )
            if not self.only_local:
                self._add_weights(d_shared[:, i], tape, grads[1 + len(k) :])
        return Observed(
            row,
            np.searchsorted(seen[0], np.arange(packed.rows + 1)),
            d_state.detach()[row, channel],
            None if d_shared is None else d_shared.detach()[row, channel],
            None if d_local is None else d_local.detach()[row, channel],
        )

    def _add_weights(self, target: Tensor, tape: Taped, cotangents: list[Tensor]) -> None:
        """Adds the weights' columns [B, columns] of one output, every tape entry covering the whole batch B."""
        for (network, layer, a, _), dz in zip(tape, cotangents, strict=True):
            begin, rows, width = self.offsets[network, layer]
            a, dz = a.detach().reshape(len(target), -1, width), dz.reshape(len(target), -1, rows)
            target[:, begin : begin + rows * width] += torch.bmm(dz.transpose(1, 2), a).reshape(len(target), -1)
            target[:, begin + rows * width : begin + rows * width + rows] += dz.sum(1)

    # ---------------------------------------------------------------- segments
    def _segments(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """For each place k: A [B, n, n] and J (shared, local) [B, n, columns] of the segments that end at rows k."""
        packed = self.problem.packed
        places = np.searchsorted(packed.row_index, np.arange(int(packed.row_index.max(initial=-1)) + 2))
        per_row = 8 * self.n_states * max(self.shared_columns, 1)
        begin = 0
        while begin < len(places) - 1:
            end = begin + 1
            while end < len(places) - 1 and (places[end + 1] - places[begin]) * per_row <= CHUNK_BYTES:
                end += 1
            rows = np.arange(places[begin], places[end])
            a, shared, local = self._segment_batch(rows)
            for k in range(begin, end):
                part = slice(int(places[k] - places[begin]), int(places[k + 1] - places[begin]))
                yield a[part], shared[part], local[part]
            begin = end

    def _segment_batch(self, rows: Integers) -> tuple[Tensor, Tensor, Tensor]:
        """A and J of the segments that end at the given rows, in their order."""
        packed, n = self.problem.packed, self.n_states
        owner = packed.row_trajectory[rows]
        first, start = self._segment_starts(rows)
        length = packed.row_step[rows] - first
        order = np.argsort(-length, kind="stable")
        batch = Batch(owner[order], first[order], length[order])
        x = start[self._tensor(order)].requires_grad_()
        k = [column.detach().clone().requires_grad_() for column in self.constants[self._tensor(batch.owner)].unbind(1)]
        tape: Taped = []
        end, calls = self._propagate(batch, x, k, tape)
        shared = self._zeros((len(rows), n, self.shared_columns))
        local = self._zeros((len(rows), n, self.parameters.n_local))
        a = self._zeros((len(rows), n, n))
        weights_wanted = bool(tape) and not self.only_local
        pre = [z for *_, z in tape] if weights_wanted else []
        activations = self._collect_activations(tape, calls, batch) if weights_wanted else {}
        owner_sorted = self._tensor(batch.owner)
        for i in range(n):
            grads = _gradients(end[:, i].sum(), [x, *k, *pre])
            a[:, i] = grads[0]
            self._add_constants(
                shared[:, i : i + 1], local[:, i : i + 1], [g[:, None] for g in grads[1 : 1 + len(k)]], owner_sorted
            )
            if weights_wanted:
                self._contract(shared[:, i], tape, grads[1 + len(k) :], activations, calls, batch)
        back = self._tensor(np.argsort(order, kind="stable"))
        return a[back], shared[back], local[back]

    def _segment_starts(self, rows: Integers) -> tuple[Integers, Tensor]:
        """Sub-step at which the segment ending at each row begins, and its state there."""
        packed = self.problem.packed
        fresh = packed.row_index[rows] == 0
        start = self.departure[self._tensor(packed.previous_row[rows])].detach().clone()
        start[self._tensor(fresh)] = self.initial[self._tensor(packed.row_trajectory[rows][fresh])].detach()
        return packed.first_step[rows], start

    def _propagate(self, batch: Batch, x: Tensor, k: list[Tensor], tape: Taped) -> tuple[Tensor, list[int]]:
        """Steps the batch to its ends; `calls[j]` tape entries were written by the first j sub-steps."""
        problem, packed = self.problem, self.problem.packed
        networks = problem.module.torch_networks(self.weights, tape)
        c = self._tensor(packed.condition[batch.owner])
        finished: list[Tensor] = [x[batch.live(0) :]]
        state = x[: batch.live(0)]
        calls = [0]
        for j in range(batch.depth):
            live = batch.live(j)
            steps, who = batch.first[:live] + j, batch.owner[:live]
            step = SubStep(
                self._tensor(packed.t[steps, who]),
                self._tensor(packed.h[steps, who]),
                c[:live],
                self._tensor(packed.inputs[steps, who]).unbind(1),
                self._arrivals[:, steps, who] if len(self._arrivals) else None,
            )
            state = advance(problem, state, step, [column[:live] for column in k], networks)
            calls.append(len(tape))
            remaining = batch.live(j + 1)
            finished.append(state[remaining:])
            state = state[:remaining]
        return torch.cat(finished[::-1]), calls

    def _collect_activations(self, tape: Taped, calls: list[int], batch: Batch) -> dict[tuple[int, int, int], Tensor]:
        """Inputs of each layer by (network, layer, group): [B, Q, width] over sub-steps, stages, elements."""
        out: dict[tuple[int, int, int], Tensor] = {}
        for group, (length, begin, end) in enumerate(batch.groups):
            for network, layer in self.offsets:
                parts = [a.detach()[begin:end] for *key, a, _ in tape[: calls[length]] if key == [network, layer]]
                if parts:
                    out[network, layer, group] = _side_by_side(parts)
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
        """Writes the weights' columns [B, columns] of one state: sum over sub-steps and stages of dz (x) a."""
        for group, (length, begin, end) in enumerate(batch.groups):
            entries = list(zip(tape[: calls[length]], cotangents[: calls[length]], strict=True))
            for (network, layer), (offset, rows, width) in self.offsets.items():
                parts = [dz[begin:end] for (*key, _, _), dz in entries if key == [network, layer]]
                if not parts:
                    continue
                dz = _side_by_side(parts)
                product = torch.bmm(dz.transpose(1, 2), activations[network, layer, group])
                target[begin:end, offset : offset + rows * width] = product.reshape(end - begin, -1)
                target[begin:end, offset + rows * width : offset + rows * width + rows] = dz.sum(1)


def _side_by_side(parts: list[Tensor]) -> Tensor:
    """Points [B, ..., width] of several calls as one [B, Q, width]; calls for whole arrays have an axis of elements."""
    return torch.cat([part.reshape(len(part), -1, part.shape[-1]) for part in parts], 1)


def _layer_offsets(parameters: Parameters) -> dict[tuple[int, int], tuple[int, int, int]]:
    """(network, layer) -> (first column, outputs, inputs); the bias follows its weight."""
    out: dict[tuple[int, int], tuple[int, int, int]] = {}
    position = 0
    for index, network in enumerate(parameters.model.networks):
        sizes = network.sizes
        for layer in range(len(sizes) - 1):
            out[index, layer] = (position, sizes[layer + 1], sizes[layer])
            position += (sizes[layer] + 1) * sizes[layer + 1]
    return out


def _gradients(output: Tensor, inputs: list[Tensor]) -> list[Tensor]:
    """Gradients of a scalar, zero where it does not depend on an input; the graph is kept."""
    if not output.requires_grad:
        return [torch.zeros_like(x) for x in inputs]
    found = torch.autograd.grad(output, inputs, retain_graph=True, allow_unused=True)
    return [torch.zeros_like(x) if g is None else g for g, x in zip(found, inputs, strict=True)]


def _rows_of_jacobian(output: Tensor, inputs: list[Tensor]) -> list[Tensor]:
    """d output[b, i] / d input[b, ...] for each input: [B, n, ...]; rows of a batch do not depend on each other."""
    rows = [_gradients(output[:, i].sum(), inputs) for i in range(output.shape[1])]
    return [torch.stack([row[j] for row in rows], 1) for j in range(len(inputs))]
