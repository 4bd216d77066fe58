"""The fits of profiles, stored in the run directory, so that an interrupted or repeated profile reuses them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Trajectories
from gbspec.runs import Run, files
from gbspec.training.optimise import Rest
from gbspec.training.profile.refits import Refit

FORMAT = "2"
"""To be changed with the definition of a fit, so that older fits are not reused."""


@dataclass
class Kept:
    """The converged fits of one constant and one member, by the constant's entry and the weights' prior.

    The file is `members/K/profile.NAME.safetensors`; `mark` identifies the weights and the data that it belongs to.
    """

    path: Path
    mark: str
    fits: dict[str, Refit]

    @staticmethod
    def of(run: Run, member: int, name: str, trajectories: Trajectories) -> Kept:
        """Reads the stored fits; there are none if the file is missing, damaged or belongs to other weights or data."""
        folder = files.member_directory(run.path, member)
        told = hashlib.sha256(f"{FORMAT} {trajectories.sha256} ".encode())
        for key, value in sorted(run.member(member).weights.items()):
            told.update(key.encode() + np.ascontiguousarray(value, dtype=np.float64).tobytes())
        kept = Kept(folder / f"profile.{name}.safetensors", told.hexdigest(), {})
        kept._read()
        return kept

    def find(self, entry: float | None, ridge: float) -> Refit | None:
        """The fit with the constant's entry of the vector at `entry` (None: free), if there is one."""
        return self.fits.get(_key(entry, ridge))

    def add(self, entry: float | None, ridge: float, made: Refit) -> None:
        """Stores a fit and writes the file immediately."""
        self.fits[_key(entry, ridge)] = made
        arrays: dict[str, Array] = {f"theta.{key}": one.rest.theta for key, one in self.fits.items()}
        numbers = {
            key: [one.rest.objective.hex(), one.rest.promised.hex(), one.rest.steps, one.fraction]
            for key, one in self.fits.items()
        }
        files.write_tensors(self.path, arrays, {"mark": self.mark, "fits": numbers})

    def _read(self) -> None:
        if not self.path.is_file():
            return
        try:
            arrays, remarks = files.read_tensors(self.path)
        except ValueError:
            return
        if remarks.get("mark") == self.mark:
            for key, (objective, promised, steps, fraction) in remarks["fits"].items():
                theta = arrays[f"theta.{key}"]
                rest = Rest(theta, float.fromhex(objective), float.fromhex(promised), int(steps))
                self.fits[key] = Refit(rest, float(fraction))


def _key(entry: float | None, ridge: float) -> str:
    return f"{entry.hex() if entry is not None else 'free'},{ridge.hex()}"
