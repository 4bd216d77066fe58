"""The standard deviations of a member's constants: those of its last stage, or, where the fit of single intervals was
kept and that of whole solutions left, those below.

If a model is right, both estimate the same constants; what separates them beyond their standard deviations shows that
it is not (Hausman 1978). Residuals of single intervals say nothing of that: a fit of them may be precise and wrong. So
constants have the standard deviations that the residuals of whole solutions give them, as predictions have, with the
difference of both fits added in squares: their intervals contain both estimates.
"""

from __future__ import annotations

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.runs import Covariance
from gbspec.training.optimise import Certainty
from gbspec.training.problem import Parameters
from gbspec.training.runs.summary import MemberResult


def take_deviations(result: MemberResult, parameters: Parameters, certainty: Certainty, factor: float) -> None:
    """Standard deviations and correlations of the last stage, wider by a factor; a marginal likelihood has others."""
    if not parameters.model.marginal:
        names = [parameters.model.learnables[i].name for i in parameters.shared]
        for name, deviation in zip(names, certainty.deviations, strict=False):
            result.sd[name] = factor * float(deviation)
        result.correlations = certainty.correlations
    if certainty.own.shape == result.own_sd.shape:
        result.own_sd = factor * certainty.own


def deviations_of_kept(
    parameters: Parameters, kept: Array, left: Array, covariance: Covariance | None
) -> dict[str, float]:
    """The standard deviation of each constant that trajectories share, by name; empty where the covariance of whole
    solutions is not known."""
    if covariance is None or not covariance.constants:
        return {}
    known, count = len(parameters.model.constants), len(covariance.constants)
    with torch.no_grad():
        at, other = (parameters.constants(torch.from_numpy(one)).numpy()[:, known:] for one in (kept, left))
    names = [one.name for one in parameters.model.learnables]
    between = {names[i]: float(np.abs(other - at)[:, i].max()) for i in parameters.shared}
    found = covariance.deviations(np.zeros((count, covariance.vectors.shape[1])), np.eye(count))
    return {name: float(np.hypot(sd, between[name])) for name, sd in zip(covariance.constants, found, strict=True)}
