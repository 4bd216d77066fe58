"""The study of the two tanks: its table."""

from __future__ import annotations

from benchmarks.studies.sets import Row
from benchmarks.studies.two_tanks import table


def test_the_table_has_a_line_for_each_seed() -> None:
    row: Row = {"cases": "c", "seed": 3, "r2": 0.99999, "naive": 0.5, "k": 0.0606, "error": 0.01, "warnings": 0,
                "seconds": 40}  # fmt: skip
    assert table([row]).splitlines()[-1] == "| 3 | 0.999990000 | 0.500 | 0.060600 | 1.0e-02 | 0 | 40 |"
