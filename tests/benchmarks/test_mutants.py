"""The mutation campaign's changes of sources, and its table."""

from __future__ import annotations

import ast
import sqlite3
from pathlib import Path

import pytest

from benchmarks.studies import mutants

SOURCE = '''"""A module."""
LIMIT = 3

def limited(x: int, y: int = 2) -> int:
    """The smaller of two."""
    if x < LIMIT and y > 0:
        return min(x + 1, y)
    raise ValueError(1 + 2)
'''


@pytest.fixture
def every(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[mutants.Mutant]:
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    (tmp_path / "a.py").write_text(SOURCE)
    return mutants.mutants_of(tmp_path / "a.py")


def test_code_of_functions_is_changed_but_neither_declarations_nor_messages(every: list[mutants.Mutant]) -> None:
    assert {mutant.line for mutant in every} == {6, 7}
    assert {mutant.change for mutant in every} >= {"min(x + 1, y) -> max(x + 1, y)", "x + 1 -> x - 1", "1 -> 2",
                                                   "x < LIMIT -> x <= LIMIT", "0 -> 1"}  # fmt: skip


def test_each_mutant_is_another_program(every: list[mutants.Mutant]) -> None:
    programs = {mutants.mutated(mutant, SOURCE) for mutant in every}
    assert len(programs) == len(every) and ast.unparse(ast.parse(SOURCE)) + "\n" not in programs
    for program in programs:
        compile(program, "a.py", "exec")


def test_nothing_else_of_a_source_changes(every: list[mutants.Mutant]) -> None:
    # templates of generated code are cut at comments
    source = SOURCE.replace("    if x", "    # a comment: α\n    if x")
    for mutant in every:
        lines = zip(source.splitlines(), mutants.mutated(mutant, source).splitlines(), strict=True)
        assert len([1 for old, new in lines if old != new]) == 1


def test_a_draw_repeats_itself() -> None:
    assert mutants.drawn(20, 3) == mutants.drawn(20, 3) != mutants.drawn(20, 4)


def test_each_package_has_its_share() -> None:
    rooms = [Path(mutant.file).parts[1] for mutant in mutants.drawn(2 * len(mutants.ROOMS), 5)]
    assert sorted(rooms) == sorted(2 * mutants.ROOMS)


def test_the_table_counts_and_lists_survivors() -> None:
    row = {"file": "gbspec/ir/a.py", "line": "3", "change": "x -> y", "tests": "2", "by": ""}
    text = mutants.table([row | {"result": "killed"}, row | {"result": "survived"}])
    assert "| ir | 2 | 1 | 0 | 1 | 0 | 50 % |" in text and "- `gbspec/ir/a.py:3`: `x -> y` (survived)" in text


def test_the_tests_of_a_mutant_are_those_that_run_its_statement(tmp_path: Path) -> None:
    """Also where coverage has the statement's first line alone; the fastest come first."""
    source = SOURCE.replace("min(x + 1, y)", "min(\n            x + 1,\n            y,\n        )")
    (tmp_path / "a.py").write_text(source)
    mutator = mutants._Mutator()
    mutator.visit(ast.parse(source))
    (lines,) = {lines for line, what, lines in mutator.found if what == "x + 1 -> x - 1"}
    assert lines == (7, 10) and {lines for line, _, lines in mutator.found if line == 6} == {(6, 6)}
    with sqlite3.connect(tmp_path / "coverage") as database:
        database.executescript(
            "create table file (id, path); create table context (id, context);"
            "create table line_bits (file_id, context_id, numbits);"
            "insert into file values (1, '/tree/a.py'), (2, '/tree/b.py');"
            "insert into context values (1, 'slow|run'), (2, 'quick|run'), (3, 'away|run'), (4, 'other|run'), (5, '');"
        )
        rows = [(1, 1, 7), (1, 2, 8), (1, 3, 6), (2, 4, 7), (1, 5, 7)]
        bits = [(file, context, bytes([0] * (line // 8) + [1 << line % 8])) for file, context, line in rows]
        database.executemany("insert into line_bits values (?, ?, ?)", bits)
    judge = mutants.Judge(tmp_path / "coverage", {"slow": 3.0, "quick": 0.1}, 40.0)
    assert judge.tests(mutants.Mutant("a.py", 0, 8, "x + 1 -> x - 1", lines)) == ["quick", "slow"]
    assert judge.tests(mutants.Mutant("a.py", 0, 4, "1 -> 2", (4, 4))) == []


def test_durations_are_read_from_a_log(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("0.50s call     tests/a.py::b\n0.25s setup    tests/a.py::b\n1 passed in 1s\n")
    assert mutants.durations(tmp_path / "log") == {"tests/a.py::b": 0.75}
