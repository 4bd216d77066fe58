"""The interface of an engine, which solves a problem's equations at a trainable vector.

An engine is bound to a problem and to the layout of its trainable vector `theta` [size]. It computes the model's
predictions and their derivatives with respect to the vector. The comparison of predictions with measurements
(residuals, losses, likelihoods) is the same for all engines: see `gbspec.training.problem` and `objective`.

To add an engine, write a class with these methods, and a line in `choice` that says when to use it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, Self, TypeVar

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.linearised import Jacobian
from gbspec.training.problem import Integers, Parameters, Path, Problem


@dataclass(frozen=True)
class Moments:
    """A model's predictions at the key rows, and the states from which they are computed.

    `mean` [R, C]; `log_sd` [R, C], the logarithm of the predictions' standard deviations if the engine computes them
    (a filter; None for a deterministic solution, where only the measurements are uncertain); states before (`before`
    [R, n_states]) and after (`after`) the arrivals at a key row; `initial` [N, n_states].
    """

    mean: Array
    before: Array
    after: Array
    initial: Array
    log_sd: Array | None = None

    @property
    def finite(self) -> bool:
        """Whether the solution is finite at all key rows."""
        return bool(np.isfinite(self.mean).all() and np.isfinite(self.before).all())


class Lack(Enum):
    """The reasons for which an engine cannot do something."""

    MODEL = "model"
    """It does not cover this model."""
    COMPILER = "compiler"
    """Something required is not installed on this machine."""
    DEVICE = "device"
    """It does not work on the requested device."""
    SECOND = "second derivatives"
    """It has no second derivatives."""


@dataclass(frozen=True)
class Unable:
    """The kind of thing that an engine cannot do, and the reason in a sentence."""

    lack: Lack
    reason: str


class UnableError(Exception):
    """Raised by an engine if a requested operation is not supported."""

    def __init__(self, unable: Unable) -> None:
        super().__init__(unable.reason)
        self.unable = unable


class Engine(Protocol):
    """Solutions of a problem and their derivatives; vectors and tables are float64 arrays.

    Where a solution is not finite, the moments contain NaN or infinities; no exception is raised.
    """

    problem: Problem
    parameters: Parameters

    def rebound(self, problem: Problem, parameters: Parameters) -> Self:
        """The same engine for another problem of the same model, or another layout of the vector."""

    def plan(self, theta: Array) -> Path:
        """The sub-steps at a vector. Solutions, derivatives and comparisons refer to one path; another vector may have
        another path (arrivals in another order, other accepted steps)."""

    def moments(self, theta: Array, path: Path) -> Moments:
        """The predictions at a vector."""

    def jacobian(self, theta: Array, path: Path, moments: Moments, scale: Array, only_local: bool = False) -> Jacobian:
        """The exact derivatives of the predicted means of measured values, each row times its entry of `scale` [R, C]
        (a residual's derivative with respect to its prediction). `moments` are those at the same vector and must be
        finite; with `only_local` the shared columns stay empty."""

    def pullback(self, theta: Array, path: Path, cotangent: Array, by: Integers | None = None) -> Array:
        """The product [size] of `cotangent` [R, C], zero where nothing was measured, with the Jacobian of the means.

        With `by` [N], the group of each trajectory (from 0): one product for each group's rows [groups, size].
        """

    def half_squares(self, theta: Array, path: Path, index: Integers | None = None) -> tuple[float, Array]:
        """Half the sum of squared residuals of the trajectories `index` (None: all) and its gradient [size], in one
        pass forward and one back."""

    def second(self, theta: Array, path: Path, direction: Array, cotangent: Array) -> Array:
        """The gradient in theta [size] of `cotangent` [R, C] times the means' Jacobian times `direction` [size].

        Raises UnableError if the engine has no second derivatives.
        """


Bound = TypeVar("Bound", bound=Engine)


def taken(engine: Bound, index: Integers) -> Bound:
    """The engine for some of the trajectories, in the order given (repeats allowed); for all of them, `engine`
    itself."""
    problem = engine.problem.take(index)
    return engine if problem is engine.problem else engine.rebound(problem, engine.parameters.take(index))


def by_group(engine: Engine, theta: Array, path: Path, cotangent: Array, by: Integers) -> Array:
    """The pullback of each group [groups, size], computed by the pullback of all rows."""
    owner = by[engine.problem.packed.row_trajectory]
    groups = int(by.max(initial=-1)) + 1
    found = [
        engine.pullback(theta, path, np.where((owner == group)[:, None], cotangent, 0.0)) for group in range(groups)
    ]
    return np.array(found).reshape(groups, engine.parameters.size)
