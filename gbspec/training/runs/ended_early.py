"""What is said of a stage that could not go on, where what was reached before is kept."""

from __future__ import annotations

from gbspec.diagnostics import ComputationError
from gbspec.training.stages import StageName

NO_FITS = frozenset({StageName.WARM_START, StageName.STARTS, StageName.STARTS_AGAIN, StageName.WHOLE_STARTS})
"""Stages that prepare a fit; alone they are no result."""
LIKELIHOODS = frozenset({StageName.MARGINAL, StageName.JUMPS, StageName.FINER, StageName.QUADRATURE})
"""The stages that end at a maximum of the likelihood where a model has one (`Model.marginal`)."""


def said_of_end(name: str, error: ComputationError, maximum: bool) -> str:
    """A warning of a stage; `maximum`: whether what is kept is what such a fit is for. Constants that are only where a
    likelihood could not go on are no estimates, and have no intervals."""
    where = f" ({error.where})" if error.where else ""
    said = f"the stage `{name}` ended early, and what was reached is kept: {error.what}{where}"
    if maximum:
        return said
    return (
        f"{said}. It is no fit: the likelihood is not at its maximum, so that constants are no estimates and have no "
        f"intervals, and AIC and BIC are left out; what may help: {error.remedy or 'other starts, or narrower bounds'}"
    )
