"""The division of data for cross-validation: by trajectories, or into blocks of successive rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gbspec.data import Trajectories, Trajectory
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
    held: tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], ...]


def way(data: Trajectories, over: Over | None) -> Over:
    """The kind of folds: as requested, otherwise trajectories, or time if there is a single trajectory."""
    return over or ("trajectories" if len(data) > 1 else "time")


def folds(data: Trajectories, over: Over, count: int | None, seed: int) -> tuple[Fold, ...]:
    """The folds: trajectories assigned at random, or blocks of successive rows of each trajectory.

    Raises UserError (GB821) if the data cannot be divided in this way.
    """
    made = _by_trajectory(data, count, seed) if over == "trajectories" else _by_time(data, count)
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


def _by_time(data: Trajectories, count: int | None) -> Iterator[Fold]:
    count = count or FOLDS
    least = min(len(item.times) for item in data.items)
    if count < 2 or least < 2 * count:
        raise _cannot(f"a trajectory of {least} rows cannot be divided into {count} blocks", "use fewer `--folds`")
    for number in range(count):
        held = tuple(_stretch(len(item.times), number, count) for item in data.items)
        kept = tuple(_without(item, rows) for item, rows in zip(data.items, held, strict=True))
        yield Fold(number, "time", replace(data, items=kept, path="", sha256="", rows=0), data, held)


def _stretch(rows: int, number: int, count: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """A mask of the rows of block `number`: successive rows; the sizes of the blocks differ by at most one."""
    edges = np.linspace(0, rows, count + 1).round()
    index = np.arange(rows)
    return np.asarray((index >= edges[number]) & (index < edges[number + 1]), dtype=np.bool_)


def _without(item: Trajectory, held: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Trajectory:
    """The trajectory without these rows; its initial time is kept, so that its first block can be predicted."""
    return item.at_rows(~held)


def _cannot(message: str, help: str) -> UserError:
    return UserError([Diagnostic("GB821", message, None, help=help)])
