"""A training problem: the model, its generated module, packed data, scales and forcing.

The loss is the mean over all measured values of rho(residual), with rho(r) = r^2 / 2, or Huber's function in stages
that use it; `gbspec.ir.residual` defines the residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gbspec.arrays import Array, Mask
from gbspec.backends import GeneratedModule
from gbspec.diagnostics import Defect
from gbspec.ir import METHODS, Censored, Model, slopes
from gbspec.training.problem.forcing import Forcing, teacher_forcing
from gbspec.training.problem.mesh import Control
from gbspec.training.problem.packing import Packed
from gbspec.training.problem.scaling import Scaling


@dataclass(frozen=True)
class Problem:
    """A training problem, independent of the engine. `module` is an instance of the generated class.

    With `control` steps are adaptive: a path divides the sub-steps of the packing by the error estimate.
    """

    model: Model
    module: GeneratedModule
    packed: Packed
    forcing: Forcing
    scaling: Scaling
    control: Control | None = None

    def __post_init__(self) -> None:
        if self.packed.nodes != tuple(map(float, METHODS[self.module.solver].nodes)):
            raise Defect(f"data were packed for another method than `{self.module.solver}`")

    @cached_property
    def seen(self) -> Mask:
        """The mask of measured values [R, C], limits included."""
        return np.asarray(self.packed.weights > 0, dtype=np.bool_)

    @cached_property
    def valued(self) -> Mask:
        """The mask of measured values [R, C] that are known, and not limits."""
        return np.asarray(self.seen & (self.packed.limits.side == 0), dtype=np.bool_)

    @cached_property
    def censored(self) -> Censored | None:
        """The measured values that are limits; None if there are none."""
        side = np.where(self.seen, self.packed.limits.side, 0).astype(np.int8)
        levels = self.scaling.levels
        return Censored(side, np.zeros(side.shape[1]) if levels is None else levels) if side.any() else None

    @cached_property
    def measured(self) -> Array:
        """The measured values and limits [R, C]; 1 where there is none."""
        found = np.where(self.packed.limits.side == 0, self.packed.values, self.packed.limits.value)
        return np.where(self.seen, found, 1.0)

    @cached_property
    def factor(self) -> Array:
        """Weights of the measured values over their scales [R, C]; 0 where there is none."""
        return np.where(self.seen, self.packed.weights / self.scaling.row_scale, 0.0)

    @cached_property
    def shares(self) -> Array | float:
        """How much each of the measured values counts [m], row by row; 1 if all count fully."""
        share = self.scaling.share
        return 1.0 if share is None else np.broadcast_to(share, self.seen.shape)[self.seen]

    def noise_terms(self, residuals: Array) -> tuple[Array, Array]:
        """Squares and counts of the residuals [m] of the measured values, each as much as it counts: the variance of
        the noise is the ratio of their sums, the counts less by the degrees of freedom of a fit."""
        if self.censored is None:
            return residuals**2, np.ones(len(residuals)) * self.shares
        squares, counts = self.censored.noise_terms(residuals, self.seen)
        return squares, counts * self.shares

    @cached_property
    def replicates(self) -> tuple[Array, Array]:
        """Sums of squares [C] of replicates' deviations from their averages, in units of the scales of the noise, and
        their degrees of freedom [C]: noise without any error of the model (Draper and Smith, Applied Regression
        Analysis, 1998, 2.1)."""
        several = self.valued & (self.packed.weights > 1.0)
        unit = self.scaling.row_scale
        if self.scaling.share is not None:
            unit = unit * np.sqrt(self.scaling.share)
        # How much a measured value that moves by one moves on the scale of its residual: d log y = dy / y.
        at = np.where(several, self.packed.values, 1.0)
        moved = slopes(at, at, several.astype(np.float64), self.scaling.log, sizes=self.scaling.sizes)
        squares = np.where(several, self.packed.scatter * (moved / unit) ** 2, 0.0)
        return squares.sum(axis=0), np.where(several, self.packed.weights**2 - 1.0, 0.0).sum(axis=0)

    def of_noise(self, residuals: Array) -> Array:
        """Residuals of the measured values [m] that have the standard deviation of the noise."""
        return residuals if self.scaling.share is None else residuals / np.sqrt(self.shares)

    def limit(self, delta: float) -> Array | float:
        """Huber's threshold `delta` of residuals with the standard deviation of the noise, for those of the fit: a
        number, or [m] where values count differently."""
        return delta if self.scaling.share is None or np.isinf(delta) else delta * np.sqrt(self.shares)

    def forced(self, blend: float) -> Problem:
        """The same problem with teacher forcing of strength `blend`: 1 teacher forcing, 0 autoregressive."""
        return replace(self, forcing=teacher_forcing(self.model, self.packed, blend))

    def take(self, indices: ArrayLike) -> Problem:
        """The same problem with some of its trajectories; with all of them in their order it is the problem itself."""
        index = np.asarray(indices, dtype=np.int64)
        if np.array_equal(index, np.arange(self.packed.trajectories)):
            return self  # keeps cached values
        packed = self.packed.take(index)
        rows = matching_rows(self.packed, packed, index)
        return replace(
            self,
            packed=packed,
            forcing=Forcing(self.forcing.value[rows], self.forcing.weight[rows]),
            scaling=replace(self.scaling, row_scale=self.scaling.row_scale[rows]),
        )


def matching_rows(whole: Packed, part: Packed, index: NDArray[np.int64]) -> NDArray[np.int64]:
    """The row of `whole` for each row of `part = whole.take(index)`."""
    return np.asarray(whole.row_table[index[part.row_trajectory], part.row_index], dtype=np.int64)
