"""The study of what can be combined: a page is read back, so that what it does not say yet can be tried alone."""

from __future__ import annotations

from benchmarks.studies.pairs import COMMANDS, STATEMENTS, text, written


def test_a_page_is_read_back_and_its_blanks_are_none_of_it() -> None:
    chosen, columns = list(STATEMENTS), list(COMMANDS)
    pairs = {(chosen[0], chosen[0]): "", (chosen[0], chosen[2]): "GB344"}
    commands = {(chosen[1], columns[0]): "GB770", (chosen[1], columns[3]): ""}
    page = text(pairs, commands, chosen)
    assert written(page, chosen) == pairs
    assert written(page, columns) == commands
    assert written("", columns) == {}
