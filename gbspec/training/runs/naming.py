"""How things are named in what is said of a fit: some of many trajectories, and what is yet to be written."""

from __future__ import annotations

from collections.abc import Sequence

from gbspec.ir import Model

NAMED = 5
"""So many labels of trajectories are listed."""


def some_of(each: Sequence[str], most: int = NAMED) -> str:
    """The first `most` of these, and how many more there are."""
    return ", ".join(each[:most]) + (f" and {len(each) - most} more" if len(each) > most else "")


def labelled(labels: Sequence[str]) -> str:
    """Labels of trajectories, not all where there are many."""
    return some_of([f"`{label}`" for label in labels])


def new_name(model: Model, name: str) -> str:
    """The name with as many underscores as no quantity of the model has."""
    each = (model.states, model.inputs, model.intermediates, model.conditions, model.algebraics, model.unknowns)
    taken = {one.name for group in each for one in group} | set(model.constant_names)
    while name in taken:
        name += "_"
    return name
