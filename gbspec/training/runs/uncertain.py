"""Constants for which the curvature at the end of a fit is no measure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from gbspec.arrays import Array
from gbspec.runs import Certainties
from gbspec.training.problem import Parameters
from gbspec.training.recipe import Context
from gbspec.training.runs.ended_own import without_own_at_bounds
from gbspec.training.runs.jumping import said_of_kinks, without_jumping
from gbspec.training.runs.misjudged import without_misjudged
from gbspec.training.runs.misjudged_disturbed import with_likelihood
from gbspec.training.runs.small_disturbances import without_disturbances
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.tied import without_tied
from gbspec.training.runs.unmoved import without_unmoved


def take_uncertain(
    result: MemberResult,
    context: Context,
    parameters: Parameters,
    theta: Array,
    stages: Sequence[str],
    known: Certainties,
) -> Certainties:
    """Takes their standard deviations from these constants, with what is to be said of them, and returns what is
    `known` without theirs. `stages` are those that led to the result."""
    if not context.model.marginal:
        misjudged = partial(without_misjudged, known=known.covariance)
        each = without_tied, without_own_at_bounds, misjudged, without_disturbances, with_likelihood
        for said in (*each, without_jumping, said_of_kinks):
            result.tied += said(result, context, parameters, theta, stages)
    result.tied += without_unmoved(result, context, stages)
    covariance = known.covariance
    at_most = {} if covariance is None else {k: v for k, v in result.at_most.items() if k in covariance.constants}
    if covariance is None or not at_most:
        return known
    return replace(known, covariance=covariance.at_most(at_most))
