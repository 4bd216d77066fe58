"""The commands of docs/analysis.md are accepted, and its figures exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.cli.command_lines import accepted

DOCUMENT = Path(__file__).parents[2] / "docs" / "analysis.md"
TEXT = DOCUMENT.read_text(encoding="utf-8")


@pytest.mark.parametrize("line", re.findall(r"^gbspec .*$", TEXT, flags=re.MULTILINE))
def test_commands_are_accepted(line: str) -> None:
    assert accepted(line)


def test_what_it_links_to_is_there() -> None:
    links = re.findall(r"\]\(([^)]+)\)", TEXT)
    assert links
    assert [link for link in links if not (DOCUMENT.parent / link.partition("#")[0]).exists()] == []
