"""Trajectories as arrays by name and back, exactly, for data that are in no table."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np

from gbspec.arrays import Array
from gbspec.data.fingerprints import fingerprint
from gbspec.data.trajectories import DoseEvents, Limits, RunIn, Signal, Trajectories, Trajectory

OF_ROWS = ("times", "values", "counts", "sd")


def content_digest(trajectories: Trajectories) -> str:
    """The SHA-256 (hexadecimal) of the content of trajectories with their labels, in their order."""
    parts = [f"{item.label}\0{fingerprint(item)}\0" for item in trajectories.items]
    return hashlib.sha256("".join(parts).encode("utf-8", "surrogatepass")).hexdigest()


def to_arrays(trajectories: Trajectories) -> tuple[dict[str, Array], dict[str, object]]:
    """The arrays and the texts (labels, channels) of trajectories."""
    arrays: dict[str, Array] = {}
    for i, item in enumerate(trajectories.items):
        arrays |= {f"{i}.{name}": getattr(item, name) for name in (*OF_ROWS, "condition")}
        before = () if item.run_in is None else (item.run_in.interval, float(item.run_in.doses))
        if item.limits is not None:
            arrays |= {f"{i}.limits": item.limits.value, f"{i}.side": item.limits.side.astype(np.float64)}
        if item.scatter is not None:
            arrays[f"{i}.scatter"] = item.scatter
        if item.assumed:
            arrays[f"{i}.assumed"] = np.array(item.assumed, dtype=np.float64)
        arrays[f"{i}.start"] = np.array([item.start, *before])
        for j, signal in enumerate(item.inputs):
            arrays |= {f"{i}.input.{j}.times": signal.times, f"{i}.input.{j}.values": signal.values}
        for j, dose in enumerate(item.doses):
            arrays |= {f"{i}.dose.{j}.times": dose.times, f"{i}.dose.{j}.amounts": dose.amounts}
    return arrays, {"labels": [item.label for item in trajectories.items], "channels": list(trajectories.channels)}


def from_arrays(
    arrays: Mapping[str, Array], labels: list[str], channels: list[str], inputs: int, doses: int
) -> Trajectories:
    """The trajectories of `to_arrays`, for a model with these numbers of inputs and doses. Raises KeyError."""
    items = tuple(
        Trajectory(
            label=label,
            start=float(arrays[f"{i}.start"][0]),
            run_in=_run_in(arrays[f"{i}.start"]),
            limits=_limits(arrays, i),
            scatter=arrays.get(f"{i}.scatter"),
            assumed=tuple(int(place) for place in arrays.get(f"{i}.assumed", ())),
            condition=arrays[f"{i}.condition"],
            inputs=tuple(
                Signal(arrays[f"{i}.input.{j}.times"], arrays[f"{i}.input.{j}.values"]) for j in range(inputs)
            ),
            doses=tuple(
                DoseEvents(arrays[f"{i}.dose.{j}.times"], arrays[f"{i}.dose.{j}.amounts"]) for j in range(doses)
            ),
            **{name: arrays[f"{i}.{name}"] for name in OF_ROWS},
        )
        for i, label in enumerate(labels)
    )
    found = Trajectories(items, tuple(channels))
    return Trajectories(items, found.channels, sha256=content_digest(found))


def _limits(arrays: Mapping[str, Array], index: int) -> Limits | None:
    """The censored entries of a trajectory, if it has any."""
    side = arrays.get(f"{index}.side")
    return None if side is None else Limits(arrays[f"{index}.limits"], side.astype(np.int8))


def _run_in(start: Array) -> RunIn | None:
    """What follows the start in its array: nothing, or the interval and the number of doses before the first row."""
    return RunIn(float(start[1]), int(start[2])) if len(start) > 1 else None
