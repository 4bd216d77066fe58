"""The division of data for cross-validation: by trajectories, or into blocks of successive rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gbspec.arrays import Mask
from gbspec.data import Limits, Trajectories, Trajectory
from gbspec.diagnostics import Diagnostic, UserError

Over = Literal["trajectories", "time"]

FEW = 20
"""Up to this many trajectories, each is left out once; with more there are five folds."""
FOLDS = 5


@dataclass(frozen=True)
class Fold:
    """One division of the data. `kept` are fitted; the rows of `whole` marked in `held` (masks [R]) are predicted.

    For folds of trajectories, `whole` are the trajectories left out, with all their rows held. For folds over time,
    `kept` and `whole` are the same trajectories in the same order, `kept` without the held rows but with the same
    initial time.
    """

    number: int
    over: Over
    kept: Trajectories
    whole: Trajectories
    held: tuple[Mask, ...]


def way(data: Trajectories, over: Over | None) -> Over:
    """The kind of folds: as requested, otherwise trajectories, or time if there is a single trajectory."""
    return over or ("trajectories" if len(data) > 1 else "time")


def folds(data: Trajectories, over: Over, count: int | None, seed: int, absent: Mask | None = None) -> tuple[Fold, ...]:
    """The folds: trajectories assigned at random, or blocks of successive rows of each trajectory.

    `absent` [N, C]: channels of states that are absent from a trajectory, which is known in every fold.

    Raises UserError (GB821) if the data cannot be divided in this way.
    """
    made = _by_trajectory(data, count, seed) if over == "trajectories" else _by_time(data, count, absent)
    return tuple(made)


def _by_trajectory(data: Trajectories, count: int | None, seed: int) -> Iterator[Fold]:
    count = count or (len(data) if len(data) <= FEW else FOLDS)
    if not 2 <= count <= len(data):
        raise _cannot(f"{len(data)} trajectories cannot be divided into {count} folds", "use `--over time`")
    dealt = np.random.default_rng([seed, 51]).permutation(len(data)) if count < len(data) else np.arange(len(data))
    for number in range(count):
        left_out = sorted(dealt[number::count].tolist())
        kept = [i for i in range(len(data)) if i not in left_out]
        whole = data.subset(left_out)
        held = tuple(np.ones(len(item.times), dtype=bool) for item in whole.items)
        yield Fold(number, "trajectories", data.subset(kept), whole, held)


def _by_time(data: Trajectories, count: int | None, absent: Mask | None) -> Iterator[Fold]:
    count = count or FOLDS
    least = min(len(item.times) for item in data.items)
    if count < 2 or least < 2 * count:
        raise _cannot(f"a trajectory of {least} rows cannot be divided into {count} blocks", "use fewer `--folds`")
    for number in range(count):
        held = tuple(_stretch(len(item.times), number, count) for item in data.items)
        known = np.zeros((len(data), len(data.channels)), dtype=np.bool_) if absent is None else absent
        kept = tuple(_without(item, rows, zero) for item, rows, zero in zip(data.items, held, known, strict=True))
        yield Fold(number, "time", replace(data, items=kept, path="", sha256="", rows=0), data, held)


def _stretch(rows: int, number: int, count: int) -> Mask:
    """A mask of the rows of block `number`: successive rows; the sizes of the blocks differ by at most one."""
    edges = np.linspace(0, rows, count + 1).round()
    index = np.arange(rows)
    return np.asarray((index >= edges[number]) & (index < edges[number + 1]), dtype=np.bool_)


def _without(item: Trajectory, held: Mask, absent: Mask) -> Trajectory:
    """The trajectory without these rows [R]; its initial time is kept, so that its first block can be predicted, and
    the zeros there of `absent` channels [C], without which their states would not be absent."""
    if not (held[0] and absent.any()):
        return item.at_rows(~held)
    rows = ~held
    rows[0] = True
    left = item.at_rows(rows)
    hidden = np.zeros(left.values.shape, dtype=np.bool_)
    hidden[0] = ~absent
    limits = left.limits
    if limits is not None:
        limits = Limits(np.where(hidden, np.nan, limits.value), np.where(hidden, np.int8(0), limits.side))
    return replace(
        left,
        values=np.where(hidden, np.nan, left.values),
        counts=np.where(hidden, 0.0, left.counts),
        sd=np.where(hidden, np.nan, left.sd),
        limits=limits,
        scatter=None if left.scatter is None else np.where(hidden, 0.0, left.scatter),
    )


def _cannot(message: str, help: str) -> UserError:
    return UserError([Diagnostic("GB821", message, None, help=help)])
