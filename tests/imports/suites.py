"""Where other people's test suites lie; they are not part of the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PLACES = [Path(os.environ.get("GBSPEC_SUITES", "")), *(ROOT.parents[i] / "shared" / "suites" for i in range(2))]


def suite(name: str) -> Path:
    """The folder of a suite, or a skipped test."""
    for place in (ROOT / "shared" / "suites", *PLACES):
        if str(place) != "." and (place / name).is_dir():
            return place / name
    pytest.skip(f"the suite `{name}` is not here; GBSPEC_SUITES names the folder that has it")
