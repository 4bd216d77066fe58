"""Every code of this part: its wrong example gets only this code, its right example none."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, UserError
from gbspec.diagnostics.catalogue import Entry, entries
from gbspec.frontend import load_model
from gbspec.passes.examination import examine

TOPICS = {"names", "balances", "algebraic", "events", "learning", "conservation", "units"}
ENTRIES = [entry for entry in entries().values() if entry.topic in TOPICS]


def findings_of(text: str, folder: Path) -> Findings:
    path = folder / f"{text.split()[1]}.gb"
    path.write_text(text)
    findings = Findings()
    try:
        examine(load_model(path, findings), findings)
    except UserError as error:
        findings.extend(error.diagnostics)
    return findings


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.code)
def test_wrong_example_gets_only_its_code(entry: Entry, tmp_path: Path) -> None:
    codes = {d.code for d in findings_of(entry.wrong + "\n", tmp_path)}
    assert codes == {entry.code}


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.code)
def test_right_example_gets_nothing(entry: Entry, tmp_path: Path) -> None:
    assert [d.code for d in findings_of(entry.right + "\n", tmp_path)] == []


def test_every_code_that_is_reported_is_in_the_catalogue() -> None:
    import re

    import gbspec

    root = Path(gbspec.__file__).parent
    used: set[str] = set()
    for folder in ("semantics", "lower", "passes"):
        for path in (root / folder).glob("*.py"):
            used.update(re.findall(r'"(GB[2349]\d\d)"', path.read_text()))
    assert used <= set(entries())
