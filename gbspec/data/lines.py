"""The records of a delimited text: where each begins, how many cells it has, which are blank or comments.

Texts are looked at in blocks: a mask of all characters, and what numpy makes of it, would take many times the memory
of the text itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Mask

BLOCK = 1 << 22
"""Characters that are looked at together."""

_Characters = NDArray[np.uint8]
_LINE_END, _QUOTE, _COMMENT = ord("\n"), ord('"'), ord("#")


@dataclass(frozen=True)
class Lines:
    """The records of a text: the header's bytes, the rows that are not blank, each record's row and width."""

    header: bytes
    body: bytes
    rows: NDArray[np.int64]
    widths: NDArray[np.int64]


def lines_of(data: bytes, separator: str) -> Lines | None:
    """Finds the beginning and the number of cells of each record; separators and line ends within quotes are text.

    None if a quote is opened and never closed.
    """
    data = data if data.endswith(b"\n") else data + b"\n"
    characters = np.frombuffer(data, dtype=np.uint8)
    quoted = b'"' in data
    ends = _ends(characters, quoted)
    if ends is None:
        return None
    starts = np.concatenate([[0], ends[:-1] + 1])
    widths, filled = _measured(characters, starts, ends, separator, quoted)
    filled &= ~_comments_above(characters, starts, filled)
    rows = np.flatnonzero(filled) + 1
    if not len(rows):
        return Lines(b"", b"", rows, widths[filled])
    first = rows[0] - 1
    header = data[starts[first] : ends[first]]
    if filled[first + 1 :].all():
        body = data[ends[first] + 1 :]
    else:
        kept = (data[starts[a] : ends[b - 1] + 1] for a, b in _runs(filled, first + 1))
        body = b"".join(kept)
    return Lines(header, body, rows, widths[filled])


def _outside(characters: _Characters) -> Mask:
    """A mask of the characters outside of quotes, of a text that begins outside of them."""
    # the parity of the number of quotes so far, which an overflow does not change
    outside: Mask = (np.cumsum(characters == _QUOTE, dtype=np.uint8) & 1) == 0
    return outside


def _ends(characters: _Characters, quoted: bool) -> NDArray[np.int64] | None:
    """The places of the line ends outside of quotes; None if the text ends within one."""
    found, inside = [], False
    for begin in range(0, len(characters), BLOCK):
        block = characters[begin : begin + BLOCK]
        end = block == _LINE_END
        if quoted:
            outside = _outside(block) ^ inside
            end &= outside
            inside = not outside[-1]
        found.append(np.flatnonzero(end) + begin)
    return None if inside else np.concatenate(found)


def _measured(
    characters: _Characters, starts: NDArray[np.int64], ends: NDArray[np.int64], separator: str, quoted: bool
) -> tuple[NDArray[np.int64], Mask]:
    """The number of cells of each record, and a mask of those that are not blank."""
    widths, filled = np.empty(len(starts), dtype=np.int64), np.empty(len(starts), dtype=bool)
    first = 0
    while first < len(starts):
        last = max(int(np.searchsorted(starts, starts[first] + BLOCK)), first + 1)
        block, at = characters[starts[first] : ends[last - 1] + 1], starts[first:last] - starts[first]
        separates = block == ord(separator)
        # A row of separators only, as spreadsheets write, is blank too.
        visible = (block != _LINE_END) & (block != ord(" ")) & (block != ord("\t")) & ~separates
        if quoted:
            separates &= _outside(block)
        widths[first:last] = np.add.reduceat(separates, at, dtype=np.int64) + 1
        filled[first:last] = np.logical_or.reduceat(visible, at)
        first = last
    return widths, filled


def _runs(kept: Mask, begin: int) -> Iterator[tuple[int, int]]:
    """The first and the last record (exclusive) of each run of records that are kept."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], kept[begin:], [False]])))
    for a, b in change.reshape(-1, 2):
        yield int(a) + begin, int(b) + begin


def _comments_above(characters: _Characters, starts: NDArray[np.int64], filled: Mask) -> Mask:
    """A mask of the comment lines above the header: those that begin with `#`, up to the first that does not."""
    comment = np.zeros(len(starts), dtype=bool)
    for line in np.flatnonzero(filled):
        if characters[starts[line]] != _COMMENT:
            break
        comment[line] = True
    return comment
