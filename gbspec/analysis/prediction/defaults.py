"""What is said of conditions of which a table has no value, so that they have their default, but which had other values
in the training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gbspec.data import Trajectory
    from gbspec.runs import Run


def defaulted(run: Run, items: Sequence[Trajectory]) -> list[int]:
    """The conditions that have their default in all trajectories since the table has no value of them, while the
    training data had other values."""
    trained, out = run.fit.data.conditions or {}, []
    for i, condition in enumerate(run.model.conditions):
        default, known = condition.default, trained.get(condition.name)
        if default is None or known is None or known == (default, default) or not items:
            continue
        if all(i in item.assumed for item in items):
            out.append(i)
    return out


def said_of_defaults(run: Run, items: Sequence[Trajectory]) -> list[str]:
    """A warning of each condition that is `defaulted`."""
    trained, out = run.fit.data.conditions or {}, []
    for condition in (run.model.conditions[i] for i in defaulted(run, items)):
        (low, high), names, default = trained[condition.name], condition.categories, condition.default or 0.0
        value = f"`{names[int(default)]}`" if names else f"{default:.6g}"
        there = f"`{names[int(low)]}`" if names else f"{low:.6g}"
        if low != high:
            there = "other values" if names else f"{there} to {high:.6g}"
        out.append(
            f"`{condition.name}` has its default, {value}, in all trajectories, as the table has no value of it; "
            f"the training data had {there}. If other values are known, write them in the table"
        )
    return out
