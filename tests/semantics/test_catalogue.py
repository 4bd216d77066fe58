"""Every code of this part: its wrong example gets it, alone; its right example gets nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, Source
from gbspec.diagnostics.catalogue import Entry, entries
from gbspec.lower import lower
from gbspec.semantics import check
from gbspec.syntax.parser import parse

TOPICS = {"names", "balances", "learning"}
ENTRIES = [entry for entry in entries().values() if entry.topic in TOPICS]


def findings_of(text: str, folder: Path) -> Findings:
    name = text.split()[1]
    path = folder / f"{name}.gb"
    path.write_text(text)
    findings = Findings()

    def load(path: Path) -> Source:
        return Source(str(path), path.read_text())

    file = parse(load(path), findings)
    assert file is not None
    checked = check(file, findings, load)
    if checked is not None:
        lower(checked, findings)
    return findings


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.code)
def test_wrong_example_gets_its_code_alone(entry: Entry, tmp_path: Path) -> None:
    codes = {d.code for d in findings_of(entry.wrong + "\n", tmp_path)}
    assert codes == {entry.code}


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.code)
def test_right_example_gets_nothing(entry: Entry, tmp_path: Path) -> None:
    assert [d.code for d in findings_of(entry.right + "\n", tmp_path)] == []


def test_every_code_that_is_reported_stands_in_the_catalogue() -> None:
    import re

    import gbspec

    root = Path(gbspec.__file__).parent
    used: set[str] = set()
    for folder in ("semantics", "lower", "passes"):
        for path in (root / folder).glob("*.py"):
            used.update(re.findall(r'"(GB[2349]\d\d)"', path.read_text()))
    assert used <= set(entries())
