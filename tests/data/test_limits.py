"""Tables beyond a limit are refused with one diagnostic; of many equal findings a few are shown."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from gbspec.data import room, sheet
from gbspec.data.columns import MOST_SURPLUS
from gbspec.data.table import read
from gbspec.diagnostics import Findings, Source, UserError
from gbspec.frontend import load_model

MODEL = load_model("m.gb", Findings(), lambda path: Source(str(path), "model m\nstate x = 1\nx' = -x\nobserve x\n"))


def found(path: Path) -> Findings:
    findings = Findings()
    try:
        read(path, MODEL, findings)
    except UserError as error:
        findings.extend(error.diagnostics)
    return findings


def codes(folder: Path, text: str) -> Counter[str]:
    (folder / "t.csv").write_text(text)
    return Counter(one.code for one in found(folder / "t.csv"))


@pytest.mark.parametrize(
    "text",
    [
        "t,x" + "," * sheet.MOST_COLUMNS + "\n0,1\n",
        "t,x," + ",".join(f"c{i}" for i in range(sheet.MOST_COLUMNS)) + "\n0,1\n",
        f"t,x\n0,1\n1,{'a' * (sheet.LONGEST_LINE + 1)}\n",
        f't,x\n0,1\n1,"{"a" * (sheet.LONGEST_LINE + 1)}"\n',
        f"t,x,{'a' * (sheet.LONGEST_LINE + 1)}\n0,1,2\n",
        f"t,x,{'a' * 200_000}\n0,1,2\n",
    ],
    ids=["nameless columns", "columns", "cell", "quoted cell", "header", "name"],
)
def test_a_table_beyond_a_limit_gets_one_error(text: str, tmp_path: Path) -> None:
    assert codes(tmp_path, text) == {"GB732": 1}


def test_a_text_that_would_take_more_memory_than_is_free_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sheet, "SMALL", 10)
    rows = "t,x\n" + "".join(f"{i},1\n" for i in range(20))
    monkeypatch.setattr(sheet, "free_memory", lambda: sheet.TIMES * len(rows))
    assert not codes(tmp_path, rows)
    monkeypatch.setattr(sheet, "free_memory", lambda: None)
    assert not codes(tmp_path, rows)
    monkeypatch.setattr(sheet, "free_memory", lambda: sheet.TIMES * len(rows) - 1)
    monkeypatch.setattr(sheet, "read_bytes", lambda _: pytest.fail("the rows were read"))
    assert codes(tmp_path, rows) == {"GB732": 1}


def test_free_memory_is_what_the_machine_and_the_group_leave(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(room, "GROUP", tmp_path)
    assert room.free_memory() is None
    (tmp_path / "meminfo").write_text("MemTotal: 90 kB\nMemAvailable:      50 kB\n")
    assert room.free_memory() == 51200
    (tmp_path / "memory.current").write_text("4000\n")
    (tmp_path / "memory.stat").write_text("anon 3500\ninactive_file 500\n")
    for most, free in (("max\n", 51200), ("5000\n", 1500), ("3000\n", 0)):
        (tmp_path / "memory.max").write_text(most)
        assert room.free_memory() == free


def test_a_small_parquet_file_of_many_rows_is_refused_by_its_footer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import polars as pl

    path = tmp_path / "t.parquet"
    pl.DataFrame({"t": np.ones(5000), "x": np.ones(5000)}).write_parquet(path)
    monkeypatch.setattr(sheet, "MOST_ROWS", 4999)
    monkeypatch.setattr(sheet.pl, "read_parquet", lambda *_: pytest.fail("the rows were read"))
    assert Counter(one.code for one in found(path)) == {"GB732": 1}


def test_of_many_unused_columns_some_are_named(tmp_path: Path) -> None:
    names = ",".join(f"c{i}" for i in range(900))
    (tmp_path / "t.csv").write_text(f"t,x,{names}\n" + "".join(f"{t},1{',1' * 900}\n" for t in range(3)))
    warned = list(found(tmp_path / "t.csv"))
    assert [one.code for one in warned] == ["GB711"] * MOST_SURPLUS
    assert f"{900 - MOST_SURPLUS} more columns" in " ".join(note for one in warned for note in one.notes)


def test_of_many_columns_with_one_name_some_are_named(tmp_path: Path) -> None:
    names = ",".join(f"c{i // 2}" for i in range(200))
    assert codes(tmp_path, f"t,x,{names}\n0,1{',1' * 200}\n") == {"GB707": sheet.SHOWN}


def test_a_long_cell_is_shortened_in_the_message(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(f"t,x\n0,1\n1,{'a' * 500_000}\n")
    (one,) = found(tmp_path / "t.csv")
    assert one.code == "GB712"
    assert len(one.message) < 300


def test_rows_and_cells_within_quotes_are_counted_as_before(tmp_path: Path) -> None:
    text = '# by hand\n\nt,x,"a note,\nof two lines"\n0,1,"a, ""b"""\n , ,\n,,\n1,2,"c\n\nd"\n'
    path = tmp_path / "t.csv"
    path.write_text(text)
    read_sheet = sheet.read_sheet(path, Findings())
    assert read_sheet is not None
    assert read_sheet.rows.tolist() == [4, 7]
    assert read_sheet.columns["x"].to_list() == ["1", "2"]
