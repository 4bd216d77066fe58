"""The records of a delimited text do not depend on the blocks in which it is looked at."""

from __future__ import annotations

import csv
import io
import random

import pytest

from gbspec.data import lines
from gbspec.data.lines import lines_of

CELLS = ("", "1", "x y", " ", '"a,b"', '"a\nb"', '"say ""x"""', "#", "é")


def some(number: int) -> str:
    """A text of a few records of such cells."""
    draw = random.Random(number)
    return "\n".join(",".join(draw.choices(CELLS, k=draw.randint(1, 3))) for _ in range(draw.randint(1, 8)))


@pytest.mark.parametrize("block", [1, 2, 5, 64])
def test_records_are_those_of_the_whole_text(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = [some(number).encode() for number in range(100)]
    whole = [lines_of(text, ",") for text in texts]
    monkeypatch.setattr(lines, "BLOCK", block)
    for text, expected in zip(texts, whole, strict=True):
        found = lines_of(text, ",")
        assert found is not None and expected is not None
        assert (found.header, found.body) == (expected.header, expected.body)
        assert found.rows.tolist() == expected.rows.tolist() and found.widths.tolist() == expected.widths.tolist()


@pytest.mark.parametrize("number", range(40))
def test_they_are_those_that_another_reader_finds(number: int) -> None:
    text = "a,b\n" + some(number)
    found = lines_of(text.encode(), ",")
    assert found is not None
    expected = [row for row in csv.reader(io.StringIO(text)) if "".join(row).strip()]
    assert list(csv.reader(io.StringIO((found.header + b"\n" + found.body).decode()))) == expected
    assert found.widths.tolist() == [len(row) for row in expected]


@pytest.mark.parametrize("text", ['a\n"b', 'a,"', '"a\n1\n2'])
@pytest.mark.parametrize("block", [1, 64])
def test_a_quote_that_is_never_closed_is_noticed(text: str, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines, "BLOCK", block)
    assert lines_of(text.encode(), ",") is None
