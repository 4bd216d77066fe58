"""The Jacobian by the native kernel: derivatives of the intervals between key rows, and their chain product.

For the method see `engines.columns`. The kernel processes some trajectories at a time, so that the derivatives of
intervals and the accumulated sensitivities stay in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.backends import network_layers
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.engines.columns import Columns
from gbspec.training.engines.deliveries import terms_of
from gbspec.training.engines.engine import Moments
from gbspec.training.engines.linearised import Jacobian, Observed
from gbspec.training.engines.native.inputs import KernelInputs
from gbspec.training.engines.native.kernel import Kernel
from gbspec.training.engines.native.tables import Tables
from gbspec.training.engines.native.threads import workspace
from gbspec.training.problem import Integers, Parameters, Problem

BLOCK_BYTES = 8 * 2**20
"""Approximate size of the derivatives that are computed before they are chained."""


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of the states at the ends of B intervals with respect to the states at their starts [B, n, n], the
    trained weights [B, n, columns] (further columns are zero) and learnable constants in natural units
    [B, n, n_learnables]."""

    start: Array
    weights: Array
    constants: Array


class Intervals:
    """The intervals that end at the key rows of a problem, at one vector with the given `moments`."""

    def __init__(
        self,
        columns: Columns,
        kernel: Kernel,
        inputs: KernelInputs,
        tables: Tables,
        moments: Moments,
    ) -> None:
        problem, parameters = columns.problem, columns.parameters
        self.problem, self.kernel, self.parameters, self.tables = problem, kernel, parameters, tables
        self.inputs, vector = inputs, torch.from_numpy(columns.theta)
        unused = np.zeros(len(inputs.weights))  # without columns of weights nothing is converted
        with torch.no_grad():
            self.factor, self.shift = (
                trained(problem, parameters, columns.theta) if columns.shared else (unused, unused)
            )
        packed = self.tables.packed
        self.first = packed.first_step
        self.steps = (packed.row_step - self.first).astype(np.int64)
        fresh = (packed.row_index == 0)[:, None]
        start = np.where(fresh, moments.initial[packed.row_trajectory], moments.after[packed.previous_row])
        self.start = np.ascontiguousarray(start)
        self.doses = Doses(problem, parameters, vector, self.tables) if len(packed.doses.time) else None

    def derivatives(self, rows: Integers, columns: int) -> Derivatives:
        """Derivatives of the intervals that end at some rows; without those by weights if `columns` is 0."""
        n, count = len(self.problem.model.states), len(rows)
        order = np.argsort(-self.steps[rows], kind="stable")
        chosen, back = rows[order], np.argsort(order, kind="stable")
        arrivals = len(self.problem.packed.doses.time)
        steps = self.steps[chosen]
        depth = int(steps.max(initial=0))
        d_start, d_weights = np.zeros((count, n, n)), np.zeros((count, n, columns))
        d_constants = np.zeros((count, n, len(self.problem.model.learnables)))
        d_amounts, d_times = np.zeros((n, arrivals)), np.zeros((n, arrivals))
        library = self.kernel.library
        intervals = library.struct(
            "Intervals",
            count=count,
            depth=depth,
            columns=columns,
            arrivals=arrivals,
            owner=np.ascontiguousarray(self.problem.packed.row_trajectory[chosen], dtype=np.int64),
            first=self.first[chosen],
            steps=steps,
            start=self.start[chosen],
            factor=self.factor,
            shift=self.shift,
            d_start=d_start,
            d_weights=d_weights if columns else None,
            d_constants=d_constants,
            d_amounts=d_amounts,
            d_times=d_times,
        )
        space = workspace(library.interval_bytes(depth))
        library.intervals(self.tables.data(library), self.inputs.struct(library), intervals, space)
        found = d_constants[back]
        if self.doses is not None:
            self.doses.add(found, rows, d_amounts, d_times)
        return Derivatives(d_start[back], d_weights[back], found)

    def blocks(self, columns: int) -> Iterator[tuple[Integers, list[Integers]]]:
        """Trajectories that are processed together, and their key rows by trajectory, in order of time."""
        packed = self.problem.packed
        most = max(1, BLOCK_BYTES // (8 * len(self.problem.model.states) * max(columns, 64)))
        order = np.lexsort((packed.row_index, packed.row_trajectory))
        bounds = np.searchsorted(packed.row_trajectory[order], np.arange(packed.trajectories + 1))
        begin = 0
        while begin < packed.trajectories:
            end = begin + 1
            while end < packed.trajectories and bounds[end + 1] - bounds[begin] <= most:
                end += 1
            rows = order[bounds[begin] : bounds[end]]
            yield np.arange(begin, end), [rows[i : i + most] for i in range(0, len(rows), most)]
            begin = end


def jacobian(
    columns: Columns, kernel: Kernel, inputs: KernelInputs, tables: Tables, moments: Moments, observed: Observed
) -> Jacobian:
    """Derivatives of the measured values; the native kernel computes those of intervals and chains them."""
    problem, parameters, packed = columns.problem, columns.parameters, columns.problem.packed
    intervals = Intervals(columns, kernel, inputs, tables, moments)
    # Every row is written once; for large data sets this is by far the largest array.
    shared = np.empty((len(observed.row), columns.shared))
    local = np.empty((len(observed.row), parameters.n_local))
    unused = [columns.zeros(())] * len(problem.model.constants)
    release, d_state = 1.0 - problem.forcing.weight, np.ascontiguousarray(observed.state.numpy())
    for who, blocks in intervals.blocks(columns.shared):
        begun, own_begun = columns.initial(torch.from_numpy(who))
        if problem.model.steady is not None:  # the only starts that depend on weights, here on the trained ones
            begun = columns.of_trained_weights(begun)
        totals = [begun.numpy(), own_begun.numpy()]
        for rows in blocks:
            found, owner = intervals.derivatives(rows, columns.shared), packed.row_trajectory[rows]
            own = np.zeros((len(rows), columns.n_states, local.shape[1]))
            of_constants = list(torch.from_numpy(found.constants).unbind(2))
            of_weights, of_own = torch.from_numpy(found.weights), torch.from_numpy(own)
            columns.add_constants(of_weights, of_own, [*unused, *of_constants], torch.from_numpy(owner))
            places = observed.bounds[rows], observed.bounds[rows + 1]
            for kind, total, out in zip((found.weights, own), totals, (shared, local), strict=True):
                chain(kernel, owner - who[0], found.start, kind, release[rows], places, d_state, total, out)
    of_shared, of_local = torch.from_numpy(shared), torch.from_numpy(local)
    if observed.shared is not None and observed.local is not None:
        of_shared += columns.of_trained_weights(observed.shared)
        of_local += observed.local
    return Jacobian(of_shared, of_local, torch.from_numpy(packed.row_trajectory)[observed.row])


def chain(
    kernel: Kernel,
    owner: Integers,
    d_start: Array,
    own: Array,
    release: Array,
    places: Sequence[Integers],
    d_state: Array,
    total: Array,
    out: Array,
) -> None:
    """Propagates the sensitivities `total` [.., n, columns] of the trajectories through B intervals in place.

    `d_start` [B, n, n] and `own` [B, n, columns] are the intervals' derivatives. Interval b writes the rows
    `places[0][b]` to `places[1][b] - 1` of the Jacobian `out` [m, columns] by means of `d_state` [m, n]; `release` [B,
    n] is the fraction of a state that a reset retains.
    """
    if not own.shape[-1]:
        return
    links = kernel.library.struct(
        "Links",
        rows=len(owner),
        columns=own.shape[-1],
        owner=np.ascontiguousarray(owner, dtype=np.int64),
        d_start=d_start,
        own=own,
        release=np.ascontiguousarray(release),
        begin=places[0],
        end=places[1],
        d_state=d_state,
        sum=total,
        out=out,
    )
    kernel.library.chain(links)


def trained(problem: Problem, parameters: Parameters, theta: Array) -> tuple[Array, Array]:
    """`factor` and `shift` [W] that convert derivatives by the kernel's weights into those by the trained weights.

    In the kernel the networks' scales are part of the first and the last layer, and contracts have transformed weights.
    For a first layer's weight w of a unit with bias b, d/dw becomes `factor * (d/dw - shift * d/db)`.
    """
    weights = parameters.weights(torch.from_numpy(theta))
    slopes = problem.module.weight_slopes({name: value.numpy() for name, value in weights.items()})
    factors, shifts = [np.zeros(0)], [np.zeros(0)]
    for network in network_layers(problem.module, weights, torch_arithmetic(problem.module)):
        center, scale = network.input_center.numpy(), network.input_scale.numpy()
        output_scale = network.output_scale.numpy()
        for i, (weight, bias) in enumerate(network.layers):
            own = np.ones(tuple(weight.shape)), np.ones(tuple(bias.shape))
            if i == len(network.layers) - 1 and not network.raw:
                own = own[0] * output_scale[:, None], own[1] * output_scale
            if i == 0:
                own = own[0] / scale, own[1]
            moved = np.broadcast_to(center, own[0].shape) if i == 0 else np.zeros(own[0].shape)
            for word, factor, shift in zip(("weight", "bias"), own, (moved, np.zeros(own[1].shape)), strict=True):
                slope = slopes.get(f"network.{network.name}.{i}.{word}", 1.0)
                factors.append((factor * slope).ravel())
                shifts.append(shift.ravel())
    return np.concatenate(factors), np.concatenate(shifts)


class Doses:
    """Contributions of learned fractions and lags of doses to the derivatives by constants."""

    def __init__(self, problem: Problem, parameters: Parameters, vector: torch.Tensor, tables: Tables) -> None:
        packed, events, known = problem.packed, problem.packed.doses, len(problem.model.constants)
        k = [column.detach().clone() for column in parameters.constants(vector).unbind(1)]
        for column in k[known:]:
            column.requires_grad_()
        terms = terms_of(problem, torch.from_numpy(packed.condition), k)

        def slopes(values: Sequence[torch.Tensor | float]) -> Array:
            """Derivatives [E, n_learnables] of fractions or lags."""
            slope: Array = np.zeros((len(terms), packed.trajectories, len(problem.model.learnables)))
            for kind, value in enumerate(values):
                if isinstance(value, torch.Tensor) and value.requires_grad:
                    found = torch.autograd.grad(value.sum(), k[known:], allow_unused=True, retain_graph=True)
                    for i, gradient in enumerate(found):
                        slope[kind, :, i] = 0.0 if gradient is None else gradient.numpy()
            return np.asarray(slope[events.kind, events.owner])

        self.of_amount = slopes([fraction for fraction, _ in terms]) * events.amount[:, None]
        self.of_time = slopes([lag for _, lag in terms])
        self.row = tables.arrival_row

    def add(self, constants: Array, rows: Integers, d_amounts: Array, d_times: Array) -> None:
        """Adds the contributions of doses [n, E] to the derivatives by constants [B, n, n_learnables] of some rows."""
        here = np.flatnonzero(np.isin(self.row, rows))
        order = np.argsort(rows)
        place = order[np.searchsorted(rows, self.row[here], sorter=order)]
        for by_arrival, slope in ((d_amounts, self.of_amount), (d_times, self.of_time)):
            np.add.at(constants, place, by_arrival.T[here][:, :, None] * slope[here][:, None, :])
