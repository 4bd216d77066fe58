"""What is said of conditions that have their default in a whole table, but had other values in the training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gbspec.data import Trajectory
    from gbspec.runs import Run


def said_of_defaults(run: Run, items: Sequence[Trajectory]) -> list[str]:
    """A warning of each condition whose value is its default in all trajectories, as where a table lacks its column,
    while the training data had other values."""
    trained, out = run.fit.data.conditions or {}, []
    for i, condition in enumerate(run.model.conditions):
        default, known = condition.default, trained.get(condition.name)
        if default is None or known is None or known == (default, default) or not items:
            continue
        if all(float(item.condition[i]) == default for item in items):
            low, high = known
            there = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
            out.append(
                f"`{condition.name}` has its default, {default:.6g}, in all trajectories, as where a table has no "
                f"column of it; in the training data it was {there}. If other values are known, write them in the table"
            )
    return out
