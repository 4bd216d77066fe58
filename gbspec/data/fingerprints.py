"""Fingerprints of trajectories by their content, independent of labels and the order of rows."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from gbspec.data.trajectories import Trajectory


def fingerprint(trajectory: Trajectory) -> str:
    """The SHA-256 (hexadecimal) of a trajectory without its label: start, times, values, conditions, inputs, doses.

    Two trajectories have the same one if and only if they have the same numbers for the same model (channels and
    conditions in the same order), bit by bit; -0 counts as 0 and all NaN as one. Rows without a measurement do not
    count: a table that is read for training has none, one that is read for prediction keeps them.
    """
    digest = hashlib.sha256()
    measured = (trajectory.counts > 0).any(axis=1)
    parts: list[NDArray[np.float64]] = [
        np.array([trajectory.start]),
        trajectory.times[measured],
        trajectory.values[measured],
        trajectory.counts[measured],
        trajectory.sd[measured],
        trajectory.condition,
    ]
    if trajectory.limits is not None:
        parts += [trajectory.limits.value[measured], trajectory.limits.side[measured].astype(np.float64)]
    for signal in trajectory.inputs:
        parts += [signal.times, signal.values]
    for events in trajectory.doses:
        parts += [events.times, events.amounts]
    for part in parts:
        numbers = np.asarray(part, dtype="<f8") + 0.0
        numbers = np.where(np.isnan(numbers), np.nan, numbers)
        digest.update(np.array(numbers.shape, dtype="<i8").tobytes())
        digest.update(np.ascontiguousarray(numbers).tobytes())
    return digest.hexdigest()
