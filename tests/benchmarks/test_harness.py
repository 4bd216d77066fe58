"""Timing of benchmarks and the documents they write."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import RESULTS, Timing, interleaved, markdown, peak_memory, pinned, write


def test_every_run_is_timed_once_per_round_after_a_warm_up() -> None:
    calls: list[str] = []
    timings = interleaved({name: lambda name=name: calls.append(name) for name in "abc"}, 4)
    assert sorted(calls[:3]) == ["a", "b", "c"]
    rounds = [calls[i : i + 3] for i in range(3, 15, 3)]
    assert [sorted(one) for one in rounds] == [["a", "b", "c"]] * 4
    assert len({tuple(one) for one in rounds}) > 1
    assert {name: len(timing.wall) for name, timing in timings.items()} == {"a": 4, "b": 4, "c": 4}


def test_no_round_starts_after_the_time_limit() -> None:
    assert len(interleaved({"a": lambda: None}, 1000, seconds=0.0)["a"].wall) == 1


def test_median_and_quartiles() -> None:
    timing = Timing([5.0, 1.0, 3.0, 2.0, 4.0], [1.0] * 5)
    assert (timing.median, timing.quartiles) == (3.0, (2.0, 4.0))
    assert timing.to_json() == {"ms": 3000.0, "low_ms": 2000.0, "high_ms": 4000.0, "cpu_ms": 1000.0, "rounds": 5}
    assert Timing([2.0]).quartiles == (2.0, 2.0)


def test_a_run_is_pinned_and_released() -> None:
    before = os.sched_getaffinity(0)
    with pinned():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_peak_memory_is_that_of_the_run() -> None:
    large, small = (peak_memory(lambda n=n: float(np.ones(n).sum())) for n in (8_000_000, 1000))
    if large is None or small is None:
        pytest.skip("this kernel does not tell the peak of memory")
    assert 50 < large < 80
    assert small < 10


def test_results_are_written_with_machine_and_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = markdown(["a", "b"], [["x", "1"]])
    assert table == "| a | b |\n|---|---:|\n| x | 1 |"
    write("made", "Made", table, {"value": 3}, tmp_path)
    text = (tmp_path / "made.md").read_text()
    assert text.startswith(f"# Made\n\n{table}\n\n")
    assert "cores" in text and "numpy" in text
    content = json.loads((tmp_path / "made.json").read_text())
    assert content["value"] == 3
    assert {"command", "date", "machine"} <= set(content)
    assert capsys.readouterr().out == table + "\n"


def test_committed_results_have_their_table() -> None:
    for path in RESULTS.glob("*.json"):
        content = json.loads(path.read_text())
        assert content["command"] in path.with_suffix(".md").read_text()
