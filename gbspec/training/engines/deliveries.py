"""Doses as functions of the trainable vector: the amount of each that arrives, and the time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import METHODS, Explicit
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.problem import Parameters, Path, Problem, echoes, path_of

Terms = list[tuple[Tensor | float, Tensor | float]]
"""Fraction and lag of each of the model's doses: tensors [B], or one number for all rows."""


def terms_of(problem: Problem, condition: Tensor, k: Sequence[Tensor]) -> Terms:
    """Fraction and lag of each of the model's doses for B trajectories, from their conditions [B, n_conditions] and
    constants ([B] or [] each). A lag that is undefined under the conditions has no gradient, which would not be
    finite."""
    terms: Terms = list(problem.module.equations.doses(torch_arithmetic(problem.module), condition, k))
    for kind, (fraction, lag) in enumerate(terms):
        if not isinstance(lag, Tensor) or not lag.requires_grad or not lag.ndim:
            continue
        sound = torch.isfinite(lag.detach())
        if not bool(sound.all()):
            some = [column[sound] if column.ndim else column for column in k]
            of_some = problem.module.equations.doses(torch_arithmetic(problem.module), condition[sound], some)[kind][1]
            terms[kind] = fraction, lag.detach().masked_scatter(sound, of_some)
    return terms + _echoed(problem, condition, k, terms)


def _echoed(problem: Problem, condition: Tensor, k: Sequence[Tensor], terms: Terms) -> Terms:
    """The terms of arrivals of nothing, at which steps begin because of delays."""
    found: Terms = []
    if problem.model.delays:
        lags = problem.module.equations.lags(torch_arithmetic(problem.module), condition.unbind(-1), k)
        for echo in echoes(problem.model):
            first = 0.0 if echo.dose is None else terms[echo.dose][1]
            found.append((0.0, sum((lags[i] for i in echo.lags), start=first)))
    return found


def delivered(problem: Problem, constants: Tensor) -> tuple[Tensor, Tensor]:
    """Amount and time of arrival of each dose [E] at the constants [N, n_constants]; differentiable in them."""
    doses = problem.packed.doses
    if not len(doses.time):
        return constants.new_zeros(0), constants.new_zeros(0)
    terms = terms_of(problem, constants.new_tensor(problem.packed.condition), constants.unbind(1))
    like = constants.new_zeros(len(constants))
    place = tuple(torch.from_numpy(table).to(constants.device) for table in (doses.kind, doses.owner))
    fraction, lag = (torch.stack([pair[i] + like for pair in terms])[place] for i in range(2))
    return fraction * constants.new_tensor(doses.amount), constants.new_tensor(doses.time) + lag


Planner = Callable[[Problem, Parameters, Array, Path], Path]
"""Chooses the steps and computes the frozen matrices of a path at a vector."""


class Paths:
    """The paths of a problem; the most recent one is kept. `planner` is needed only for adaptive and implicit steps."""

    def __init__(self, problem: Problem, planner: Planner | None = None) -> None:
        self._problem, self._planner = problem, planner
        explicit = isinstance(METHODS[problem.module.solver], Explicit)
        self._fixed = planner is None or (problem.control is None and explicit)
        self._path: Path | None = None
        self._theta: Array | None = None

    def at(self, parameters: Parameters, theta: Array) -> Path:
        """The path at a vector."""
        if self._fixed or self._planner is None:
            return self._arranged(parameters, theta)
        if self._path is None or self._theta is None or not np.array_equal(theta, self._theta, equal_nan=True):
            self._path = None  # the path of doses is computed again, since steps have replaced its cells
            self._path = self._planner(self._problem, parameters, theta, self._arranged(parameters, theta))
            self._theta = theta.copy()
        return self._path

    def _arranged(self, parameters: Parameters, theta: Array) -> Path:
        """The packing, cut where doses arrive."""
        doses = self._problem.packed.doses
        time = doses.time
        if all(doses.known) and self._path is not None:
            return self._path  # the times of arrival do not depend on the vector
        if len(time):
            with torch.no_grad():
                constants = parameters.constants(torch.from_numpy(theta))
                time = delivered(self._problem, constants)[1].numpy()
        if self._path is None or not np.array_equal(time, self._path.time, equal_nan=True):
            self._path = path_of(self._problem.packed, time)
        return self._path
