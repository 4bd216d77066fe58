"""Whether two readings of a table have the same content, where other programs read its numbers or labels otherwise."""

from __future__ import annotations

import math

import numpy as np

from gbspec.arrays import Array
from gbspec.data.keeping import to_arrays
from gbspec.data.trajectories import Trajectories

ROUNDING = 1e-14
"""Some readers of texts miss the nearest floating-point number by a few units in the last place (pandas)."""


def same_content(one: Trajectories, other: Trajectories) -> bool:
    """Whether trajectories, of the same model, have the same numbers but for `ROUNDING`, in the same order, and the
    same labels, or labels that are the same numbers (`01` is 1 to most programs)."""
    (ours, texts), (theirs, said) = to_arrays(one), to_arrays(other)
    if texts["channels"] != said["channels"] or ours.keys() != theirs.keys():
        return False
    labels = [[_number(item.label) for item in each.items] for each in (one, other)]
    return labels[0] == labels[1] and all(_near(ours, theirs, name) for name in ours)


def _number(label: str) -> float | str:
    """A label as a number, if it is one as tables write them: finite, and not `1_0`, which only Python reads."""
    try:
        number = float(label)
    except ValueError:
        return label
    return number if math.isfinite(number) and "_" not in label else label


def _near(ours: dict[str, Array], theirs: dict[str, Array], name: str) -> bool:
    """Whether two arrays are the same but for rounding; that of a scatter is one of the squares of its values."""
    first, second = ours[name], theirs[name]
    if first.shape != second.shape:
        return False
    size: Array | float = 0.0
    trajectory, _, kind = name.partition(".")
    if kind == "scatter":
        size = np.nan_to_num(ours[f"{trajectory}.values"] ** 2 * ours[f"{trajectory}.counts"])
    with np.errstate(invalid="ignore"):  # the difference of two infinite numbers
        near = np.abs(first - second) <= ROUNDING * (np.abs(first) + size)
    return bool(np.all(near | (first == second) | (np.isnan(first) & np.isnan(second))))
