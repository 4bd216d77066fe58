"""Conversion of every offset to an editor's position and back, in every encoding."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gbspec.diagnostics import Source
from gbspec.lsp.positions import Encoding, to_offset, to_position
from gbspec.lsp.workspace import Workspace

TEXTS = st.text(st.sampled_from("ax1 \tμ𝒙é😀\n'=*"), max_size=40)


@given(TEXTS, st.sampled_from(["utf-8", "utf-16", "utf-32"]))
def test_every_offset_comes_back(text: str, encoding: Encoding) -> None:
    source = Source("m.gb", text)
    for offset in range(len(text) + 1):
        assert to_offset(source, to_position(source, offset, encoding), encoding) == offset


@given(TEXTS, st.sampled_from([("utf-8", "utf-8", 1), ("utf-16", "utf-16-le", 2), ("utf-32", "utf-32-le", 4)]))
def test_columns_are_those_of_the_encoded_line(text: str, encoding: tuple[Encoding, str, int]) -> None:
    name, codec, size = encoding
    source = Source("m.gb", text)
    for offset in range(len(text) + 1):
        line = text[:offset].rsplit("\n", 1)[-1]
        assert to_position(source, offset, name) == (text[:offset].count("\n"), len(line.encode(codec)) // size)


@pytest.mark.parametrize(
    ("position", "offset"),
    [((-1, 4), 0), ((0, 99), 3), ((9, 0), 7), ((1, 1), 4), ((1, 2), 5), ((1, -3), 4)],
)
def test_invalid_positions_are_moved_to_the_nearest_valid_one(position: tuple[int, int], offset: int) -> None:
    assert to_offset(Source("m.gb", "abc\n😀b\n"), position) == offset


def test_line_ends_and_byte_order_mark_are_not_counted(tmp_path: object) -> None:
    workspace = Workspace()
    workspace.put(f"{tmp_path}/m.gb", "model m\r\n\tstate\rx")
    source = workspace.source(f"{tmp_path}/m.gb")
    assert to_position(source, source.text.index("state")) == (1, 1)
    assert to_position(source, source.text.index("x")) == (2, 0)
