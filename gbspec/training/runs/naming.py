"""How some of many trajectories are named in what is said of a fit."""

from __future__ import annotations

from collections.abc import Sequence

NAMED = 5
"""So many labels of trajectories are listed."""


def some_of(each: Sequence[str], most: int = NAMED) -> str:
    """The first `most` of these, and how many more there are."""
    return ", ".join(each[:most]) + (f" and {len(each) - most} more" if len(each) > most else "")


def labelled(labels: Sequence[str]) -> str:
    """Labels of trajectories, not all where there are many."""
    return some_of([f"`{label}`" for label in labels])
