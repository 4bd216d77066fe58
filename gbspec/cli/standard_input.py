"""A model that comes from standard input, under the name `-`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gbspec.diagnostics import Source

STANDARD_INPUT = "-"
"""The name of the model that stands for standard input."""


def read(path: str | Path) -> Source:
    """The text of a model; that of `-` comes from standard input, and what it extends is in the current folder."""
    from gbspec import frontend
    from gbspec.syntax import decode

    return decode("<stdin>", sys.stdin.buffer.read()) if path == STANDARD_INPUT else frontend.read_source(path)
