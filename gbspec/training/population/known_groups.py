"""What a fit has learned of the groups of its data: further trajectories of a group have its deviation, not another."""

from __future__ import annotations

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.population.objective import Objective, Point


def learned_groups(objective: Objective, point: Point) -> dict[str, object]:
    """For each value of each column that groups trajectories, what is known of its deviations (those of a constant's
    spread: of logarithms, if it is lognormal), as JSON.

    `of` has entries [column, value, places among the distributed constants [m], modes [m], their covariance [m, m] if
    all parameters were known, and their derivatives [m, k] by `constants`]. Groups of other columns, with which these
    are connected by trajectories of both, are integrated out.
    """
    layout, likelihood = objective.layout, objective.marginal.likelihood
    names = [condition.name for condition in layout.model.conditions]
    condition = objective.marginal.predictions.problem.packed.condition
    natural = layout.natural(torch.from_numpy(point.u).expand(likelihood.trajectories, -1))
    with torch.no_grad():
        factor = layout.factor(natural)[0].numpy()
        of = likelihood.at(natural, torch.from_numpy(point.z), point.weights)
        posterior = np.linalg.inv(likelihood.expected_hessian(of).numpy())
    constants, slopes = _slopes(objective, point)
    out = []
    for column in dict.fromkeys(level.column for _, level in layout.levels):
        levels = [e for e, (_, level) in enumerate(layout.levels) if level.column == column]
        places = [layout.levels[e][0] for e in levels]
        sd = np.array([factor[k, layout.effects + e] for k, e in zip(places, levels, strict=True)])
        values, first = np.unique(condition[:, names.index(column)], return_index=True)
        for value, n in zip(values.tolist(), first.tolist(), strict=True):
            unit = int(likelihood.groups.unit[n])
            slot = likelihood.groups.slot[n, [layout.effects + e for e in levels]]
            covariance = posterior[unit][np.ix_(slot, slot)] * np.outer(sd, sd)
            mode, by = sd * point.z[unit, slot], sd[:, None] * slopes[unit, slot]
            if np.isfinite(covariance).all() and np.isfinite(mode).all():
                out.append([column, value, places, mode.tolist(), covariance.tolist(), by.tolist()])
    return {"constants": constants, "of": out}


def _slopes(objective: Objective, point: Point) -> tuple[list[str], Array]:
    """The constants that all trajectories share, medians by the name of what they are the median of, and the
    derivatives [units, size, k] of the modes by them."""
    layout = objective.layout
    at = list(layout.typical.values())
    by_natural = layout.bijections.derivative(point.u)[at]
    found = objective.marginal.mode_slopes(point.u, point.weights, point.z)[..., at]
    slopes = np.divide(found, by_natural, out=np.zeros_like(found), where=by_natural > 0)  # 0: at a bound
    return list(layout.typical), np.where(np.isfinite(slopes), slopes, 0.0)
