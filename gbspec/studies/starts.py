"""True and learned initial states of trajectories, and the eigenvalues there (paper, discussion).

An error along directions that decay before the next measurement is harmless, and no data can reveal it; the error
is split into a fast and a slow part. Its unit D is the standard deviation of the true initial states. With J the true
Jacobian at the true initial state, the modes of D^-1 J D that decay below 1/e within the mean interval between
measurements span the fast part, the others the slow part. States measured at the initial time are exact by construction
and not counted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis import (
    input_values,
    learned_start,
    needed,
    ordered_eigenvalues,
    true_starts,
    truth_evaluator,
    truth_model,
)
from gbspec.arrays import Array
from gbspec.studies.record import Complex, Eigenvalues, Extent, InitialStates

if TYPE_CHECKING:
    from gbspec.backends import Evaluator
    from gbspec.data import SimulateOptions, Trajectories
    from gbspec.runs import Run

Spectrum = np.ndarray[tuple[int], np.dtype[np.complex128]]
Spectra = np.ndarray[tuple[int, int], np.dtype[np.complex128]]


@dataclass(frozen=True)
class Starts:
    """True and learned initial states [N, n] of all trajectories, and the data needed to compare them."""

    run: Run
    data: Trajectories
    interval: float
    truth: Evaluator
    learned: Evaluator
    true: Array
    found: Array

    @classmethod
    def of(cls, run: Run, data: Trajectories, sampling: SimulateOptions) -> Starts:
        """Those of a run's first member on simulated data. Raises ComputationError if the truth cannot be solved."""
        from gbspec.backends import Evaluator

        truth, learned = truth_evaluator(run.model), Evaluator(run.member(run.numbers[0]))
        true = true_starts(truth, truth_model(run.model), sampling)
        found = np.array([learned_start(learned, i, item).state for i, item in enumerate(data.items)])
        return cls(run, data, sampling.dt, truth, learned, true, found)

    def eigenvalues(self) -> Eigenvalues:
        """Spectra at the first trajectory's initial state, and median distances to the truth over all trajectories.

        `true` are the eigenvalues of the true Jacobian at the true initial state, by decreasing real part;
        `learned_at_true` and `learned` those of the learned Jacobian at the true and at the learned initial state, in
        the order of the true ones (by the assignment of least total distance); `error_at_true` and `error` [n] are the
        distances.
        """
        true = self._spectra(self.truth, self.true)
        at_true = matched(self._spectra(self.learned, self.true), true)
        learned = matched(self._spectra(self.learned, self.found), true)
        return Eigenvalues(
            self.data.items[0].label,
            _parts(true[0]),
            _parts(at_true[0]),
            _parts(learned[0]),
            tuple(np.median(np.abs(at_true - true), axis=0).tolist()),
            tuple(np.median(np.abs(learned - true), axis=0).tolist()),
        )

    def _spectra(self, evaluator: Evaluator, states: Array) -> Spectra:
        return np.array([ordered_eigenvalues(self._jacobian(evaluator, i, state)) for i, state in enumerate(states)])

    def _jacobian(self, evaluator: Evaluator, index: int, state: Array) -> Array:
        item = self.data.items[index]
        inputs = input_values(self.run.model, item, np.array([item.start]))[0]
        return np.asarray(evaluator.jacobian_at(item.start, state, item.condition, inputs), dtype=np.float64)

    def initial_states(self) -> InitialStates:
        """Errors of learned initial states, in standard deviations of the true ones: medians and maxima.

        `states` by state, over the `n` trajectories in which it was not measured at the initial time; `fast` and `slow`
        along these directions, over the trajectories in which some state was not measured then.
        """
        scale = self.true.std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        off = (self.found - self.true) / scale
        free = np.zeros(off.shape, dtype=bool)
        for i, item in enumerate(self.data.items):
            free[i, list(needed(self.run.model, item))] = True
        split = np.array([self._split(i, off[i], scale) for i in np.flatnonzero(free.any(axis=1)).tolist()]).reshape(
            -1, 2
        )
        states = {state.name: _extent(np.abs(off[free[:, k], k])) for k, state in enumerate(self.run.model.states)}
        return InitialStates(states, _extent(split[:, 0]), _extent(split[:, 1]))

    def _split(self, index: int, off: Array, scale: Array) -> tuple[float, float]:
        """The lengths of the fast and the slow part of a difference [n] (in standard deviations)."""
        jacobian = self._jacobian(self.truth, index, self.true[index]) * scale / scale[:, None]
        values, vectors = np.linalg.eig(jacobian)
        parts = vectors * np.linalg.solve(vectors, off.astype(complex))
        fast = values.real * self.interval < -1.0
        return float(np.linalg.norm(parts[:, fast].sum(axis=1))), float(np.linalg.norm(parts[:, ~fast].sum(axis=1)))


def matched(spectra: Spectra, reference: Spectra) -> Spectra:
    """Each row of eigenvalues in the order of the reference's row, by the assignment of least total distance."""
    from scipy.optimize import linear_sum_assignment

    rows = []
    for values, wanted in zip(spectra, reference, strict=True):
        _, order = linear_sum_assignment(np.abs(wanted[:, None] - values[None, :]))
        rows.append(values[order])
    return np.array(rows)


def _parts(values: Spectrum) -> tuple[Complex, ...]:
    return tuple((float(value.real), float(value.imag)) for value in values)


def _extent(values: Array) -> Extent:
    return Extent(len(values), float(np.median(values)), float(values.max())) if len(values) else Extent(0, None, None)
