"""Fingerprints of trajectories by their content, independent of labels and the order of rows."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.data.trajectories import Trajectory


def fingerprint(trajectory: Trajectory) -> str:
    """The SHA-256 (hexadecimal) of a trajectory without its label: start, times, values, conditions, inputs, doses.

    Two trajectories have the same one if and only if they have the same numbers for the same model (channels and
    conditions in the same order), bit by bit; -0 counts as 0 and all NaN as one. Rows without a measurement do not
    count: a table that is read for training has none, one that is read for prediction keeps them.
    """
    parts = _measured(trajectory, measured_rows(trajectory))
    for signal in trajectory.inputs:
        parts += [signal.times, signal.values]
    for events in trajectory.doses:
        parts += [events.times, events.amounts]
    return _digest(parts)


def beginning(trajectory: Trajectory, rows: int) -> str:
    """The same of its first `rows` measured rows alone, with the inputs and doses until the last of them."""
    kept = measured_rows(trajectory)[:rows]
    parts, end = _measured(trajectory, kept), trajectory.times[kept].max(initial=-np.inf)
    for signal in trajectory.inputs:
        parts += [signal.times[signal.times <= end], signal.values[signal.times <= end]]
    for events in trajectory.doses:
        parts += [events.times[events.times <= end], events.amounts[events.times <= end]]
    return _digest(parts)


def beginnings(items: Sequence[Trajectory]) -> list[list[int | str]]:
    """What `continued` recognises trajectories by: the number of measured rows of each, and their `beginning`."""
    counts = [len(measured_rows(item)) for item in items]
    return [[rows, beginning(item, rows)] for rows, item in zip(counts, items, strict=True)]


def continued(known: object, items: Sequence[Trajectory]) -> list[tuple[int, int] | None]:
    """Which of the trajectories that are `known` by their `beginnings` each one begins with, and the number of rows up
    to the last one of these; the longest, if it begins with several. A single row is no beginning."""
    listed = known if isinstance(known, list) else []
    table = {(rows, content): place for place, (rows, content) in enumerate(listed)}
    counts = sorted({int(rows) for rows, _ in table if rows >= 2}, reverse=True)
    out: list[tuple[int, int] | None] = []
    for item in items:
        measured = measured_rows(item)
        fitting = (rows for rows in counts if rows <= len(measured))
        rows = next((rows for rows in fitting if (rows, beginning(item, rows)) in table), None)
        out.append(None if rows is None else (table[rows, beginning(item, rows)], int(measured[rows - 1]) + 1))
    return out


def measured_rows(trajectory: Trajectory) -> NDArray[np.int64]:
    """The rows of a trajectory that have a measurement."""
    return np.flatnonzero((trajectory.counts > 0).any(axis=1))


def _measured(trajectory: Trajectory, rows: NDArray[np.int64]) -> list[Array]:
    """Start, condition, and what some rows measure."""
    parts: list[Array] = [
        np.array([trajectory.start]),
        trajectory.times[rows],
        trajectory.values[rows],
        trajectory.counts[rows],
        trajectory.sd[rows],
        trajectory.condition,
    ]
    if trajectory.limits is not None:
        parts += [trajectory.limits.value[rows], trajectory.limits.side[rows].astype(np.float64)]
    return parts


def _digest(parts: Sequence[Array]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        numbers = np.asarray(part, dtype="<f8") + 0.0
        numbers = np.where(np.isnan(numbers), np.nan, numbers)
        digest.update(np.array(numbers.shape, dtype="<i8").tobytes())
        digest.update(np.ascontiguousarray(numbers).tobytes())
    return digest.hexdigest()
