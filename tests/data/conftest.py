"""A reader of tables given as texts in tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.data.table import read
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.ir.model import Model
from tests.data.hand_models import reactor
from tests.data.reader import Reader


@pytest.fixture
def reading(tmp_path: Path) -> Reader:
    """Reads a text as a table for a model: the trajectories (None if it is wrong) and all diagnostics, in order."""

    def read_text(
        text: str | bytes, model: Model | None = None, name: str = "table.csv", require_channels: bool = True
    ) -> tuple[Trajectories | None, list[Diagnostic]]:
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        findings = Findings()
        try:
            found = read(path, model or reactor(), findings, require_channels)
        except UserError as error:
            assert error.diagnostics == tuple(findings)
            return None, list(findings)
        return found, list(findings)

    return read_text
