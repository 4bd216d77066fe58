"""What is said of a stage that could not go on, where what was reached before is kept."""

from __future__ import annotations

from collections.abc import Sequence

from gbspec.diagnostics import ComputationError
from gbspec.training.stages import StageName

NO_FITS = frozenset({StageName.WARM_START, StageName.STARTS, StageName.STARTS_AGAIN, StageName.WHOLE_STARTS})
"""Stages that prepare a fit; alone they are no result."""
LIKELIHOODS = frozenset(
    {
        StageName.MARGINAL,
        StageName.JUMPS,
        StageName.OTHER_MAXIMA,
        StageName.FINER,
        StageName.QUADRATURE,
        StageName.INNOVATIONS,
    }
)
"""The stages that end at a maximum of the likelihood where a model has one (`Model.marginal`, or disturbances)."""

WHOLE = frozenset({StageName.AUTOREGRESSIVE, StageName.AS_ASKED})
"""The stages that fit whole solutions where intervals were fitted before."""

NO_WHOLE = (
    "whole solutions were not fitted: what is kept was fitted to parts of the trajectories (from one row to the next, "
    "or segments), whose residuals would make intervals of constants too narrow, so that there are none"
)
NO_FIT = (
    "the likelihood is not at its maximum, so that constants are no estimates and have no intervals, and AIC and BIC "
    "are left out"
)


def said_of_end(name: str, error: ComputationError, marginal: bool, maximum: bool, begun: bool = True) -> str:
    """A warning of a stage. In a `marginal` model `maximum` says whether a maximum of the likelihood was reached before
    it; constants that are only where a likelihood could not go on are no estimates, and have no intervals. `begun`:
    whether the stage took a step."""
    where = f" ({error.where})" if error.where else ""
    at_maximum = maximum and (marginal or name == StageName.OTHER_MAXIMA)
    kept = "the maximum of the likelihood that was reached before" if at_maximum else "what was reached"
    said = f"the stage `{name}` ended early, and {kept} is kept: {error.what}{where}"
    if name in WHOLE and not begun:
        said += f". So {NO_WHOLE}"
    if maximum or not marginal:
        return f"{said}; what may help: {error.remedy}" if error.remedy else said
    return f"{said}. It is no fit: {NO_FIT}; what may help: {error.remedy or 'other starts, or narrower bounds'}"


def without_whole(notes: Sequence[str]) -> bool:
    """Whether a fit is that of intervals or segments since whole solutions, which were to be fitted, blew up. `notes`
    are those of its `Position`."""
    return any(NO_WHOLE in note for note in notes)


def said_of_unfinished(name: str, error: ComputationError) -> str:
    """A warning of a stage that took its last step before a maximum of the likelihood."""
    return f"the stage `{name}` ended early: {error.what}. It is no fit: {NO_FIT}; what may help: {error.remedy}"


def said_of_no_maximum(notes: Sequence[str], maximum: bool, held: bool) -> list[str]:
    """What is to be said of a finished fit of a model with a likelihood where what is kept is not its maximum, and no
    stage that ended early has said so. `notes`, `maximum` and `held` are those of its `Position`."""
    if maximum and held:
        return [
            "held-out data chose a point on the way to the maximum of the likelihood, where they are predicted best: "
            "AIC and BIC, which are of maxima, are left out, and intervals are approximate. Without `--holdout` the "
            "maximum is kept"
        ]
    if maximum or any(NO_FIT in note for note in notes):
        return []
    return [f"the stage `{StageName.MARGINAL}` did not run: {NO_FIT}. Add it to `--stages`, or leave these out"]
