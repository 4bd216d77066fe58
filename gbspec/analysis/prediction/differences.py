"""Steps of finite differences by what a trajectory is solved with.

A start that the data determine far better than its prior does bends the solution within a small part of the prior's
standard deviation: a step is short enough where it changes the residuals by a small part of themselves.
"""

from __future__ import annotations

LONGEST, SHORTEST = 1e-3, 1e-7
"""Steps are between these, in standard deviations of the prior."""
PART = 1e-2
"""The change of the residuals that a step should make, as a part of their root mean square."""
EXACT = 1e-2
"""Residuals, in deviations of the data, count as if they were at least so large: a change of a hundredth of them is far
beyond the error of the solutions."""
TOO_LONG = 10.0
"""A step so many times longer than it should be is repeated."""


def suited(step: float, change: float, residual: float) -> float:
    """The step that suits residuals with the root mean square `residual`, of which `step` has changed that by `change`;
    both in deviations of the data. Not finite: nothing is known but that it was too long."""
    if not change < float("inf"):
        return max(step / 100.0, SHORTEST)
    if change == 0.0:
        return LONGEST
    return min(max(step * PART * max(residual, EXACT) / change, SHORTEST), LONGEST)
