"""What a checkpoint holds beside its arrays."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.runs import StageRecord
from gbspec.training.starts import CurveKind


@dataclass(frozen=True)
class Exact:
    """Numbers of a checkpoint in hexadecimal, since they may be infinite or NaN, which JSON does not have."""

    loss: str
    best_score: str
    freedom: str


@dataclass(frozen=True)
class Remarks:
    """What a checkpoint holds beside its arrays; see `Position`. Losses and constants of the history are hexadecimal.

    `smooth`: whether the measured values were smoothed for the warm start, `pieces`: whether piece by piece.
    `maximum`, `held` and `entry_ridge` (hexadecimal) are those of a `Position`; older checkpoints have none.
    `common`: whether all members hold out the same trajectories; in older checkpoints their seeds chose them.
    """

    stage: int
    iteration: int
    seconds: float
    finished: bool
    smooth: bool
    stages: tuple[StageRecord, ...]
    notes: tuple[str, ...]
    exact: Exact
    history: tuple[tuple[str, int, float, str, tuple[str, ...]], ...]
    best_stages: int = 0
    pieces: bool = False
    maximum: bool | None = None
    held: bool | None = None
    entry_ridge: str | None = None
    common: bool = False

    @property
    def curves(self) -> CurveKind:
        """The kind of the curves of the warm start."""
        return "pieces" if self.pieces else "smooth" if self.smooth else "interpolating"
