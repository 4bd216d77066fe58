"""Reports of training while it runs; a class that shows them implements `Progress`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol


@dataclass(frozen=True)
class Update:
    """One iteration of one member.

    `total` is the largest number of iterations of the stage; `loss` is the mean over measured values of half the
    squared residual; `constants` are shared learned constants by name; `seconds_left` is an estimate of the time to the
    end; `remark` says in words how far the stage is.
    """

    member: int
    stage: str
    iteration: int
    total: int
    loss: float
    seconds: float
    seconds_left: float | None = None
    constants: Mapping[str, float] = field(default_factory=dict)
    remark: str = ""


class Progress(Protocol):
    """Receives events in order; called in the process that called `train`."""

    def update(self, update: Update) -> None:
        """Receives a completed iteration."""

    def message(self, text: str) -> None:
        """Receives a remark for the user: a decision, a warning."""


class Silent:
    """Shows nothing."""

    def update(self, update: Update) -> None:
        """Does nothing."""

    def message(self, text: str) -> None:
        """Does nothing."""
