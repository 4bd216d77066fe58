"""The comparison of two checkouts: order of the pairs, ratios and their interval; a commit compared with itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.against import HERE, Worker, command_seconds, interval, pairs, row


@pytest.mark.parametrize(("count", "ranks"), [(3, (1, 3)), (5, (1, 5)), (6, (1, 6)), (9, (2, 8)), (20, (6, 15))])
def test_the_interval_of_a_median_is_that_of_the_tables(count: int, ranks: tuple[int, int]) -> None:
    """Ranks of the usual tables for 95 % (Conover 1999, table A3)."""
    values = [float(rank) for rank in range(count, 0, -1)]
    assert interval(values) == ranks


def test_both_are_called_equally_often_and_the_ratio_is_this_by_the_other() -> None:
    """The untimed call of each comes first; a row gives the other's time, this one's and their ratio."""
    calls = {"this": 0, "other": 0}

    def timed(name: str, seconds: float) -> float:
        calls[name] += 1
        return seconds

    found = pairs(lambda: timed("this", 0.002), lambda: timed("other", 0.001), 7)
    assert calls == {"this": 8, "other": 8}
    assert found == [(0.002, 0.001)] * 7
    assert row("work", found) == ["work", "1 ms", "2 ms", "2.000", "2.000 to 2.000", "7"]


def test_a_command_that_fails_ends_the_comparison(tmp_path: Path) -> None:
    """A time of a command that failed is none."""
    with pytest.raises(Exception, match="returned non-zero exit status"):
        command_seconds(HERE, ["check", "no_such_model"], tmp_path, tmp_path)


def test_a_worker_times_the_functions_that_it_names() -> None:
    """The worker's program fits the benchmarks of this checkout."""
    worker = Worker(HERE, trajectories=6)
    try:
        assert "Jacobian, kernel" in worker.names
        assert worker.seconds("step, native float32") > 0
    finally:
        worker.process.kill()
