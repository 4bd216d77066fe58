"""What the covariance of the estimates says of single trajectories, and of what all of them share.

A trajectory's constants are the mode z*(u) given the parameters u, and its inner Hessian says how uncertain they are if
u were known. With the covariance C of u their variance is larger by the square of dk/du = k_u + k_z dz*/du under C
(Kass and Steffey, J. Am. Stat. Assoc. 84, 1989, 717): for a linear model with known spreads that is exact. Without it
the constants of trajectories that tell little, or do not differ, would seem to be known better than their median.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.runs import Covariance
from gbspec.training.population.layout import Layout
from gbspec.training.population.objective import Objective, Point

UNKNOWN = 1.0
"""A spread is taken to be known to such a factor e at least: where data leave open whether it is zero, its standard
deviation on the scale of logarithms has any size, over which nothing is linear."""


def of_parameters(objective: Objective, point: Point, weights: Array, covariance: Array) -> Array:
    """The variance [N, q] of the distributed constants of trajectories due to the covariance [P, P] of u; parameters
    of which nothing is known, as of a spread that ended at zero, are left out."""
    known = np.flatnonzero(np.isfinite(np.diag(covariance)))
    limits = _limits(objective.layout, covariance)
    limited = (covariance * np.outer(limits, limits))[np.ix_(known, known)]
    slopes = objective.marginal.individual_slopes(point.u, weights, point.z)[..., known]
    variance = np.einsum("nqp,pr,nqr->nq", slopes, limited, slopes)
    return np.where(np.isfinite(variance), np.maximum(variance, 0.0), 0.0)


def _limits(layout: Layout, covariance: Array) -> Array:
    """Factors [P] of the parameters' standard deviations: 1, of spreads such that they are at most `UNKNOWN`."""
    deviation = np.sqrt(np.maximum(np.nan_to_num(np.diag(covariance)), 0.0))
    made = [learnable.distribution for learnable in layout.distributed if learnable.distribution is not None]
    spreads = {name for each in made for name, _ in each.spreads}
    chosen = np.array([name in spreads for name in layout.names], dtype=bool)
    return np.where(chosen, np.minimum(1.0, UNKNOWN / np.maximum(deviation, 1e-300)), 1.0)


def of_shared(layout: Layout, u: Array, covariance: Array, ridge: float) -> Covariance | None:
    """The covariance of weights and constants, as other fits keep it, from that of (w, u) [W + P, W + P].

    Constants of single trajectories are represented by their medians; spreads, correlations and noises, which no
    function contains, are integrated out. None where that of the weights is not known; constants of which it is not
    known are left out.
    """
    count = len(covariance) - len(u)
    of_weights = covariance[:count, :count]
    if not np.isfinite(of_weights).all():
        return None
    variances = np.diag(covariance)[count:]
    places = {name: place for name, place in layout.typical.items() if np.isfinite(variances[place])}
    at = [count + place for place in places.values()]
    slopes = layout.bijections.derivative(u)[list(places.values())]
    across = slopes[:, None] * covariance[at, :count]
    own = slopes[:, None] * covariance[np.ix_(at, at)] * slopes
    values, vectors = np.linalg.eigh(of_weights)
    # Directions that the data determine best have the rounding errors of those that they determine least.
    values = np.maximum(values, np.finfo(float).eps * float(values.max(initial=0.0)))
    coupling = -(across @ vectors / values) @ vectors.T
    shares = np.minimum(values * ridge, 1.0)
    kept = np.flatnonzero(shares < 1.0)
    conditional = own + coupling @ across.T
    if not (np.isfinite(coupling).all() and np.isfinite(conditional).all()):
        return None
    return Covariance(
        names=tuple(layout.parameters.weight_shapes),
        constants=tuple(places),
        spread=float(ridge**-0.5) if count else 0.0,
        vectors=np.ascontiguousarray(vectors[:, kept].T),
        shares=shares[kept],
        coupling=coupling,
        conditional=conditional,
    )
