"""Gaps in inputs that are otherwise recorded, and what are none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gbspec.data import read
from gbspec.diagnostics import Diagnostic, Findings
from gbspec.frontend import load_model

MODEL = """model heated
time t
input Ta {kind}
state T = 20
T' = 0.1*(Ta - T)
observe T
"""


def said(
    folder: Path, cells: Sequence[str], kind: str = "held", times: Sequence[float] | None = None
) -> list[Diagnostic]:
    (folder / "m.gb").write_text(MODEL.format(kind=kind))
    rows = [
        f"{t},{20 + 0.1 * i:.1f},{u}" for i, (t, u) in enumerate(zip(times or range(len(cells)), cells, strict=True))
    ]
    (folder / "d.csv").write_text("t,T,Ta\n" + "\n".join(rows) + "\n")
    findings = Findings()
    read(folder / "d.csv", load_model(folder / "m.gb", Findings()), findings)
    return list(findings)


RECORDED = [str(20 + i % 7) for i in range(30)]


def with_gap(first: int, count: int) -> list[str]:
    return ["" if first <= i < first + count else cell for i, cell in enumerate(RECORDED)]


@pytest.mark.parametrize(
    ("kind", "first", "taken"),
    [
        ("held", 12, "in this gap its last value before, 24, is held"),
        ("linear", 12, "in this gap it is interpolated"),
        ("linear", 20, "in this gap its last value before, 25, is held"),  # nothing comes after it
    ],
)
def test_a_gap_and_what_is_taken_in_it_are_named(tmp_path: Path, kind: str, first: int, taken: str) -> None:
    (found,) = said(tmp_path, with_gap(first, 10), kind)
    assert found.code == "GB792" and taken in found.message
    assert f"has no value at 10 times, from {first} to {first + 9} (from row {first + 2} on)" in found.message


def test_the_longest_of_several_is_named(tmp_path: Path) -> None:
    cells = [a and b for a, b in zip(with_gap(3, 5), with_gap(15, 7), strict=True)]
    (found,) = said(tmp_path, cells)
    assert "7 times" in found.message and found.message.endswith("(there is one more gap)")


def test_short_gaps_and_single_empty_cells_beside_a_gap(tmp_path: Path) -> None:
    empty = {5, 44, *range(12, 22), *range(30, 34)}
    (found,) = said(tmp_path, ["" if i in empty else str(20 + i % 7) for i in range(60)])
    assert "no value at 10 times" in found.message and "all others" not in found.message


def test_in_the_long_layout_there_are_no_empty_rows(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text(MODEL.format(kind="held"))
    rows = [f"{t},T,{20 + 0.1 * t:.1f}" for t in range(30)] + [f"{t},Ta,20" for t in range(30) if not 12 <= t < 22]
    (tmp_path / "d.csv").write_text("t,name,value\n" + "\n".join(rows) + "\n")
    findings = Findings()
    read(tmp_path / "d.csv", load_model(tmp_path / "m.gb", Findings()), findings)
    (found,) = findings
    assert "`Ta` has no value at 10 times, from 12 to 21" in found.message and "empty" not in found.message


@pytest.mark.parametrize(
    "cells",
    [
        pytest.param(RECORDED, id="none"),
        pytest.param(with_gap(12, 4), id="short"),
        pytest.param(["20", *[""] * 9, "25", *[""] * 9, "22", *[""] * 9], id="where it changes"),
        pytest.param([cell if i % 5 == 0 else "" for i, cell in enumerate(RECORDED)], id="a clock of its own"),
        pytest.param([*RECORDED[:12], *[""] * 18], id="a program that ends early"),
    ],
)
def test_what_is_no_gap(tmp_path: Path, cells: list[str]) -> None:
    assert said(tmp_path, cells) == []


def test_rows_close_together_are_no_gap(tmp_path: Path) -> None:
    times = [float(i) if i < 12 else 11 + 0.1 * (i - 11) if i < 20 else float(i) for i in range(30)]
    assert said(tmp_path, with_gap(12, 8), times=times) == []
