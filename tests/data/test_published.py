"""A published table that is not there: the message says where to get it, for every table that a page names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gbspec.data.published import PUBLISHED, where_to_get
from gbspec.data.sheet import read_sheet
from gbspec.diagnostics import Findings

PAGE = (Path(__file__).parents[2] / "docs" / "data_sources.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", PUBLISHED)
def test_an_absent_published_table_is_explained(name: str, tmp_path: Path) -> None:
    findings = Findings()
    assert read_sheet(tmp_path / f"{name}.csv", findings) is None
    (found,) = findings
    assert found.code == "GB701" and PUBLISHED[name] in found.help and "docs/data_sources.md" in found.help


def test_any_other_absent_table_is_just_absent(tmp_path: Path) -> None:
    assert where_to_get(tmp_path / "mine.csv") == ""


def test_a_table_that_is_there_but_cannot_be_read_is_not_explained_so(tmp_path: Path) -> None:
    findings = Findings()
    (tmp_path / "hare_lynx.csv").mkdir()
    assert read_sheet(tmp_path / "hare_lynx.csv", findings) is None
    assert [found.help for found in findings] == [""]


def test_the_page_has_every_table_with_its_terms() -> None:
    listed = set(re.findall(r"^\| \[`(\w+)\.csv`\]", PAGE, re.M))
    assert listed == set(PUBLISHED)
    assert PAGE.count("\n- Terms: ") == PAGE.count("\n- Origin") == len(PUBLISHED)
