"""Every diagnostic code of contracts: its wrong example gives only this code; its right example gives none."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import UserError
from gbspec.diagnostics.catalogue import Entry, entries
from tests.contracts.helpers import whole_model

ENTRIES = [entry for entry in entries().values() if entry.topic == "contracts"]


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.code)
def test_the_wrong_example_gives_only_its_code(entry: Entry) -> None:
    with pytest.raises(UserError) as caught:
        whole_model(entry.wrong + "\n")
    assert {d.code for d in caught.value.diagnostics} == {entry.code}


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.code)
def test_the_right_example_gives_no_diagnostic(entry: Entry) -> None:
    model = whole_model(entry.right + "\n")
    assert any(unknown.form is not None for unknown in model.unknowns)
