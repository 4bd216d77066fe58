"""The run directory: what training writes and everything else reads."""

from gbspec.runs.store import Run, open_run

__all__ = ["Run", "open_run"]
