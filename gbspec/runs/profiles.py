"""The results of profiles that were made of a run: `members/K/profile.NAME.json`, read and written only here.

A result is of the member's weights at that time; of other weights (a continued training) it is not read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from gbspec.runs import files
from gbspec.runs.typed_json import OMITTED, JsonError, decode, encode, read_object

Trust = Literal["profile", "fit", "both", "neither"]
"""Which of two intervals of a constant to trust; `both` where they agree."""


@dataclass(frozen=True)
class ProfileRecord:
    """The 90 % interval of a profile (None: an end is open, both if some fit has not converged), and how it compares
    with the interval in `fit.json`: which one to `trust`, and a `verdict` in words where they disagree.

    `weights` is the digest of the member's weights file.
    """

    constant: str
    member: int
    estimate: float
    interval: tuple[float | None, ...]
    trust: Trust
    verdict: str | None = field(default=None, metadata=OMITTED)
    weights: str = ""


def write_profile(directory: Path, record: ProfileRecord) -> None:
    """Writes the result of a profile into the run `directory`, with the digest of the weights that it is of."""
    folder = files.member_directory(directory, record.member)
    weights = files.digest(folder / files.WEIGHTS)
    files.write_json(folder / f"profile.{record.constant}.json", {**encode(record), "weights": weights})


def read_profile(directory: Path, member: int, constant: str) -> ProfileRecord | None:
    """The result of a constant's profile; None if there is none of these weights, or its file is damaged."""
    folder = files.member_directory(directory, member)
    path = folder / f"profile.{constant}.json"
    if not path.is_file():
        return None
    try:
        record = decode(ProfileRecord, read_object(path))
        return record if record.weights == files.digest(folder / files.WEIGHTS) else None
    except (OSError, JsonError):
        return None
