"""The maximum of the likelihood near a fit whose sizes of disturbances and noises are those of the restricted one.

Criteria and ratios of likelihoods are of maxima. The restricted sizes are larger than the likeliest ones, the more the
more constants were estimated, so that -2 log likelihood at them is above its minimum by about p^2/(2n).
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.optimise.priors import Priors
from gbspec.training.optimise.restricted import FLAT, LEAST, inverse

STEPS, HALVINGS, LONGEST = 10, 8, 1.0
"""Scoring steps, halvings of each, and how far an entry moves in one."""
ENOUGH = 1e-5
"""Steps end where the next promises less of the log likelihood."""


def likeliest(engine: FilterEngine, vector: Array, found: Filtered) -> float:
    """The negative log likelihood at its maximum near the vector of a fit, `found` being the filter there. With priors,
    which weights of networks have too, that of the fit: the maximum without them is another matter."""
    parameters = engine.parameters
    if parameters.n_weights or len(Priors.of(engine.problem, parameters, np.zeros(1))) or not found.finite:
        return found.value
    least = engine.noise.least()
    at, best = vector, found
    for _ in range(STEPS):
        information = engine.information(at, best)
        moving = np.where(np.diag(information.matrix) > 10 * FLAT, engine.layout.free, 0.0)  # not what is at a bound
        step = -inverse(information.matrix, moving, LEAST) @ information.gradient
        step = np.clip(step, -LONGEST, LONGEST)
        if not -0.5 * float(step @ information.gradient) > ENOUGH:
            break
        for halving in range(HALVINGS):
            trial = at + 0.5**halving * step
            trial[parameters.size :] = np.maximum(trial[parameters.size :], least)
            new = engine.filtered(trial, guess=best.guess)
            if new.value < best.value:
                break
        else:
            break
        at, best = trial, new
    return best.value


__all__ = ["likeliest"]
