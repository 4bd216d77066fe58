"""Labels that a spreadsheet would take for formulas are written so that it does not, and read as they were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gbspec.data import Trajectories, read, write
from gbspec.data.names import for_spreadsheets, from_spreadsheets
from gbspec.diagnostics import Findings
from tests.training.conftest import model_of, trajectory

LABELS = [
    "=cmd|' /C calc'!A0",
    "+1+1",
    "-2+3",
    "@SUM(A1)",
    "-1",
    "1e3",
    "plain",
    "'=x",
    "'quoted",
    "'-1",
    "''=",
    '=é,"b',
]


@pytest.mark.parametrize("suffix", ["csv", "tsv", "parquet"])
def test_labels_come_back_and_are_no_formulas(suffix: str, tmp_path: Path) -> None:
    model = model_of("model m\nstate x\nlearn k = 1\nx' = -k*x\nobserve x\n")
    one = trajectory("", 0.0, [0.0, 1.0], [[1.0], [0.5]], [])
    data = Trajectories(tuple(replace(one, label=label) for label in LABELS), ("x",))
    path = tmp_path / f"table.{suffix}"
    write(path, data, model)
    assert [item.label for item in read(path, model, Findings()).items] == LABELS
    if suffix == "csv":
        cells = [line.lstrip('"') for line in path.read_text().splitlines()[1:]]
        assert all(cell[0] not in "=+@" for cell in cells)
        assert all(cell.startswith("-1,") for cell in cells if cell[0] == "-"), "numbers stay numbers"


def test_what_users_write_is_not_changed() -> None:
    for label in ("'a'", "'", "''", "-1", "'-1", "O'Neill"):
        assert from_spreadsheets(label) == label
    assert for_spreadsheets("=1") == "'=1"
