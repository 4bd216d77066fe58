"""Events in a problem: how near to the end of a sub-step they wait for the next one."""

from __future__ import annotations

import numpy as np

from gbspec.training.problem.problem import Problem

BAND = 1e-10
"""Within this share of the longest step of its end a step leaves events to the next one, after what arrives there."""
ROUNDING = 3e-14
"""The same where steps are adaptive, as a share of the last time: above the rounding of times, whatever the steps."""


def band_of(problem: Problem) -> float:
    """The time before the end of a sub-step within which events wait for the next one."""
    packed = problem.packed
    if problem.control is None:
        return BAND * packed.max_step
    return ROUNDING * float(np.abs(packed.row_time).max(initial=np.abs(packed.start).max(initial=0.0)))
