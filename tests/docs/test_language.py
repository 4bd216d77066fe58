"""The reference of the language: every example compiles, and every statement has one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gbspec import frontend
from gbspec.diagnostics import Findings, Severity, UserError
from gbspec.syntax.ast import WORDS as STATEMENTS

REFERENCE = Path(__file__).parents[2] / "docs" / "language.md"
BLOCKS = re.findall(r"^```gb(?: file=(\S+))?\n(.*?)^```$", REFERENCE.read_text(encoding="utf-8"), re.S | re.M)
NAMES = [re.match(r"model (\w+)", text)[1] for _, text in BLOCKS]  # type: ignore[index]  # each begins so


@pytest.mark.parametrize("text", [text for _, text in BLOCKS], ids=NAMES)
def test_every_example_compiles_without_a_diagnostic(text: str, tmp_path: Path) -> None:
    for name, other in BLOCKS:
        if name:
            (tmp_path / name).write_text(other)
    path = tmp_path / "example.gb"
    path.write_text(text)
    findings = Findings()
    try:
        model = frontend.load_model(path, findings)
    except UserError:
        pending = {d.code for d in findings if d.severity is Severity.ERROR}
        # a statement that the reference describes may still answer "not supported yet", and nothing else
        assert all(code.startswith("GB9") for code in pending), [d.message for d in findings]
        pytest.skip(f"not supported yet: {', '.join(sorted(pending))}")
    assert model.states
    assert [d.message for d in findings] == []


@pytest.mark.parametrize("statement", STATEMENTS)
def test_every_statement_has_an_example(statement: str) -> None:
    assert any(re.search(rf"^{statement} ", text, re.M) for _, text in BLOCKS), f"no example uses `{statement}`"
