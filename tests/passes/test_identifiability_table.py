"""The page of known answers has every case and agrees with the output of `gbspec check`."""

from __future__ import annotations

import pytest

from tests.passes.identifiability_cases import FURTHER, UNDECIDED
from tests.passes.identifiability_table import HEAD, PAGE, cases, row
from tests.passes.test_identifiability import CASES, PAPER

LOOKED_AT = ("factor of an unknown", "scaled argument", "scale of a channel", "two compartments", "no effect")


def test_the_page_has_every_case() -> None:
    text = PAGE.read_text("utf-8")
    assert text.startswith(HEAD)
    rows = text.removeprefix(HEAD).splitlines()
    assert len(rows) == len(CASES) + len(FURTHER) + len(UNDECIDED) + len(PAPER) >= 50
    assert [line.split(" | ")[0].removeprefix("| ") for line in rows] == list(cases())


@pytest.mark.parametrize("name", LOOKED_AT)
def test_a_row_is_what_check_says(name: str) -> None:
    assert row(name, *cases()[name]) in PAGE.read_text("utf-8")
