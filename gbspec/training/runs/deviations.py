"""The standard deviations of a member's constants: those of its last stage, or, where the fit of single intervals was
kept and that of whole solutions left, those below.

If a model is right, both estimate the same constants; what separates them beyond their standard deviations shows that
it is not (Hausman 1978). Residuals of single intervals say nothing of that: a fit of them may be precise and wrong. So
constants have the standard deviations that the residuals of whole solutions give them, as predictions have, and where
the fit that was left follows these more closely, the difference of both fits is added in squares: on the scale on which
a constant is trained, its interval contains both estimates.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.runs import Covariance
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.optimise import Certainty
from gbspec.training.problem import Parameters, mean_loss
from gbspec.training.runs.summary import MemberResult

MUCH = 0.9
"""A loss of whole solutions below this part of another one is told."""


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
    engine: Engine, kept: Array, left: Array | None, covariance: Covariance | None
) -> dict[str, float]:
    """The standard deviation of each constant that trajectories share, by name, in natural units; empty where the
    covariance of whole solutions, which `engine` solves, is not known. `left` is the fit of these; None: `kept` is."""
    if covariance is None or not covariance.constants:
        return {}
    count, parameters = len(covariance.constants), engine.parameters
    found = covariance.deviations(np.zeros((count, covariance.vectors.shape[1])), np.eye(count))
    between = np.zeros(count)
    if left is not None and _loss(engine, left) < _loss(engine, kept):
        slopes = parameters.bijections(parameters.shared).derivative(kept[parameters.places])
        between = np.abs(slopes * (left - kept)[parameters.places])
    names = [parameters.model.learnables[i].name for i in parameters.shared]
    assert tuple(names) == covariance.constants, "it is that of this layout"
    return dict(zip(names, map(float, np.hypot(found, between)), strict=True))


def said_of_left(engine: Engine, kept: Array, left: Array) -> list[str]:
    """What the fit of whole solutions that was left would have given, where its loss is clearly smaller; `engine`
    solves both at the step of the result."""
    here, there = _loss(engine, kept), _loss(engine, left)
    if not there < MUCH * here:
        return []
    return [
        f"the whole solutions of the fit of intervals, which was kept, have the loss {here:.3g}; with the fit of whole "
        f"solutions, which was left, it is {there:.3g}. `--forcing autoregressive` fits whole solutions alone and may "
        "reach that, as predictions of many rows need"
    ]


def _loss(engine: Engine, theta: Array) -> float:
    return mean_loss(residual_vector(engine, theta))
