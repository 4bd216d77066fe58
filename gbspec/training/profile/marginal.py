"""Profiles of fits by a marginal likelihood: of populations, learned noises and counts.

The constant, or the median of its distribution, is held at successive values, and all other parameters (constants,
spreads, correlations, noises, weights) are refitted; the deviance is the difference of -2 log L, with the priors and
the ridge of the fit, by the same step and the same method (Laplace's, or quadrature).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.data import Trajectories
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.runs import Run, files
from gbspec.training.options import TrainOptions
from gbspec.training.population import Counted, Point, modes_of, with_held
from gbspec.training.problem import Bijection
from gbspec.training.profile.assembled import Basis, Fitted, Report, profile_from
from gbspec.training.profile.result import Profile
from gbspec.training.recipe import marginal_objective
from gbspec.training.runs import agreed, restored_fit

INSIDE = 1e-3
"""Fits begin with a parameter off its bounds by this share of the range."""
FLAT = 1e-8
"""An entry with less of the largest information has none: its scale ends there."""


def profile_of_likelihood(
    run: Run, name: str, trajectories: Trajectories, member: int, points: int, iterations: int, progress: Report | None
) -> Profile:
    """The profile of a constant that trajectories share, of the median of a distributed one, or of a spread, at most
    `points` values to either side; each refit takes at most `iterations` steps.

    Raises UserError (GB777) if the fit is not at a maximum of its likelihood.
    """
    profiler = _OfLikelihood(run, name, trajectories, member, iterations)
    return profile_from(run, member, profiler, profiler.estimate, points, progress)


class _OfLikelihood:
    """Maxima of the likelihood with one parameter held."""

    def __init__(self, run: Run, name: str, trajectories: Trajectories, member: int, iterations: int) -> None:
        options = TrainOptions.recorded(run.fit.options, run.path)
        options = agreed(run.fit.backend, run.model, run.module, options)
        directory = files.member_directory(run.path, member)
        context, parameters, position = restored_fit(run.model, run.module, trajectories, options, member, directory)
        if not position.maximum or position.held:
            raise _no_maximum(run)
        self.model, self.iterations, self.ridge = run.model, iterations, float(position.ridge)
        self.objective = marginal_objective(context, parameters, [one.name for one in position.fitted_stages])
        layout, theta = self.objective.layout, position.best
        self.layout, self.weights = layout, parameters.n_weights
        z = modes_of(parameters, self.objective.marginal.likelihood, theta)
        self.point = self.objective.at(theta[: self.weights], theta[layout.slice()], z, self.ridge, afresh=True)
        self.name = name
        self.place = layout.typical[name] if name in layout.typical else layout.names[name]  # a spread
        column = self.weights + self.place
        self.basis = Basis(name, column, run.fit.quantile**2, Bijection.of(layout.each[self.place]))
        begun = self._begun()
        self.basis.deviation = self._deviation(begun)
        self.estimate = self._fitted(begun, begun.objective, converged=True)
        beside = self.basis.beside(self.estimate.value)
        if beside is not None:
            self.basis.part = beside.part(float(begun.u[self.place]), self.basis.deviation)
        self._points: dict[float, Point] = {float(self.estimate.theta[column]): begun}

    def _begun(self) -> Point:
        """Where fits begin: the estimate, or what lies inside of the bound at which it ended, from where no step leads
        away on the scale of training."""
        value = float(self._natural(self.point.u)[self.place])
        inside = self.basis.map.inside(value, INSIDE)
        if math.isclose(inside, value, rel_tol=1e-9, abs_tol=0.0):
            return self.point
        found, point = with_held(
            Counted(self.objective), self.point, self.ridge, self.place, inside, steps=self.iterations
        )
        return point if math.isfinite(found) else self.point

    def _deviation(self, begun: Point) -> float:
        """The standard deviation of the entry by the expected information; infinite if that is not known."""
        curvature = self.objective.curvature(begun, self.ridge) / 2
        column, diagonal = self.basis.column, np.diag(curvature)
        variance = float(np.linalg.pinv(curvature, hermitian=True)[column, column])
        known = diagonal[column] > FLAT * diagonal.max() and variance > 0
        return math.sqrt(variance) if known else math.inf

    def held(self, entry: float, neighbour: Fitted) -> Fitted:
        """The maximum with the parameter's entry at `entry`, from that of a neighbour."""
        start = self._points[float(neighbour.theta[self.basis.column])]
        u = start.u.copy()
        u[self.place] = entry
        given = self.point, self.ridge, self.place, float(self._natural(u)[self.place]), start
        found, point = with_held(Counted(self.objective), *given, steps=self.iterations)
        if point is start:
            return Fitted(given[3], np.concatenate([start.weights, u]), math.inf, False)
        made = self._fitted(point, found if math.isfinite(found) else point.objective, math.isfinite(found))
        self._points[float(made.theta[self.basis.column])] = point
        return made

    def _fitted(self, point: Point, objective: float, converged: bool) -> Fitted:
        value = float(self._natural(point.u)[self.place])
        return Fitted(value, np.concatenate([point.weights, point.u]), objective, converged)

    def _natural(self, u: Array) -> Array:
        return self.layout.natural(torch.from_numpy(u)).numpy()

    def others(self, one: Fitted) -> dict[str, float]:
        """The other constants of a fit, of distributed ones the medians."""
        natural = self._natural(one.theta[self.weights :])
        return {name: float(natural[place]) for name, place in self.layout.typical.items() if name != self.name}

    def said_of_estimate(self, estimate: float) -> list[str]:
        """Nothing: the criterion is that of the fit, and a lower one is said where it is found."""
        return []

    def remarks(self, fits: Sequence[Fitted]) -> list[str]:
        """A sentence on priors, which the deviance contains."""
        if not self.objective.priors:
            return []
        return ["constants have priors: the deviance is that of the posterior density, not of the likelihood alone"]


def _no_maximum(run: Run) -> UserError:
    message = f"the fit of `{run.path}` is not at a maximum of its likelihood, around which a profile is computed"
    help_text = "the warnings of the run say why, and what may help; with `--holdout` held-out data chose the point"
    return UserError([Diagnostic("GB777", message, None, help=help_text)])
