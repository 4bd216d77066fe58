"""The type of the fixture `reading`."""

from __future__ import annotations

from collections.abc import Callable

from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Diagnostic

Reader = Callable[..., tuple[Trajectories | None, list[Diagnostic]]]
"""(text, model, name of the file, whether channels are required) -> trajectories (None if wrong) and diagnostics."""
