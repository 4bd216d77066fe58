"""Digests of the files of a run, by which later damage is noticed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import Findings
from gbspec.runs import files
from gbspec.runs.member import MemberRecord, StageRecord
from gbspec.runs.record import FitRecord
from gbspec.runs.typed_json import JsonError, decode, encode

if TYPE_CHECKING:
    from gbspec.backends import GeneratedModule

FIT, SEAL = "fit", "sha256"
"""Keys of `info` in a weights file: the summary of the fit that the weights are of, and the digest of the rest."""
SEALED = (files.WEIGHTS, files.CHECKPOINT, files.CHECKPOINT_BEST)
"""The files of a member whose digests are in `fit.json`."""
OF_RUN = (files.MODEL, files.MODULE, files.HISTORY, files.DATA)
"""The other files of a run whose digests are in `fit.json`."""
RESTORE = "restore the file from a copy, or train again into another directory"


@dataclass(frozen=True)
class Summary:
    """What a member's weights file says of its fit, so that a run can be used whose training was killed.

    `constants` are the learned ones by name, the mean of those that are per trajectory; `noise` is by channel.
    """

    seed: int
    loss: float | None
    rmse: Mapping[str, float | None]
    seconds: float
    stages: tuple[StageRecord, ...]
    noise: Mapping[str, float | None]
    constants: Mapping[str, float]
    finished: bool

    def record(self, member: int) -> MemberRecord:
        """The member's entry of `fit.json`."""
        return MemberRecord(self.seed, self.loss, self.rmse, self.seconds, self.stages, member)


def sealed(info: Mapping[str, object], weights: Mapping[str, Array], summary: Summary) -> dict[str, object]:
    """The `info` of a weights file with the summary of its fit, and a digest of everything in the file."""
    whole = {**info, FIT: encode(summary)}
    return {**whole, SEAL: files.digest_of(weights, json.dumps(whole))}


def opened(member: GeneratedModule) -> Summary | None:
    """The summary in a weights file, None for one of version 0.1.0. Raises ValueError if the file was changed, or has
    no initial state for each of its trajectories."""
    info = dict(member.info)
    known = info.get("fingerprints")
    if known and np.shape(member.weights.get("initial", ())) != (len(known), len(member.states)):
        raise ValueError("it has not an initial state for each of its trajectories")
    if SEAL not in info:
        return None
    if info.pop(SEAL) != files.digest_of(member.weights, json.dumps(info)):
        raise ValueError("its content is not what was written")
    if not isinstance(info.get(FIT), dict):
        raise ValueError("the summary of its fit is missing")
    try:
        return decode(Summary, info[FIT], FIT)
    except JsonError as error:
        raise ValueError(str(error)) from None


def sealed_record(directory: Path, record: FitRecord) -> FitRecord:
    """The record of a run with the digests of the files that are in its directory."""
    members = tuple(
        replace(entry, files=_digests(files.member_directory(directory, entry.member or 0), SEALED))
        for entry in record.members
    )
    return replace(record, members=members, files=_digests(directory, OF_RUN))


def _digests(place: Path, names: Sequence[str]) -> dict[str, str]:
    return {name: files.digest(place / name) for name in names if (place / name).is_file()}


def check(directory: Path, fit: FitRecord, findings: Findings) -> None:
    """Compares the files of a finished run with their digests: GB853 for weights, GB852 for others."""
    where = {directory / name: digest for name, digest in (fit.files or {}).items() if name in OF_RUN}
    for entry in fit.members:
        place = files.member_directory(directory, entry.member or 0)
        kept = (files.WEIGHTS,) if not (place / files.WEIGHTS).is_file() else SEALED
        where |= {place / name: digest for name, digest in (entry.files or {}).items() if name in kept}
    for path, digest in where.items():
        code = "GB853" if path.name == files.WEIGHTS else "GB852"
        if not path.is_file():
            findings.error(code, f"`{path}` is missing", None, help=RESTORE)
        elif files.digest(path) != digest:
            findings.error(code, f"`{path}` was changed after training: its content is damaged", None, help=RESTORE)
