"""The time that a fit may still take is estimated by what its stages needed so far."""

from __future__ import annotations

import pytest

from gbspec.runs import StageRecord
from gbspec.training.runs.pace import seconds_left

TOTALS = {"warm start": 1, "teacher forcing": 60, "initial states": 1, "autoregressive": 60}


def test_before_any_stage_of_several_iterations_all_are_expected() -> None:
    assert seconds_left([StageRecord("warm start", 1, 0.1, 9.0)], TOTALS, 2.0, 4, 60, 61) == pytest.approx(0.5 * 117)


def test_a_single_step_alone_tells_nothing() -> None:
    assert seconds_left([], TOTALS, 1.5, 1, 1, 300) is None


def test_a_slow_single_step_says_nothing_of_iterations() -> None:
    """Refitting initial states took 15 s, and "at most 1 h 31 min left" was said of a fit of two minutes."""
    before = [StageRecord("warm start", 1, 0.1, 9.0), StageRecord("teacher forcing", 12, 0.1, 6.0)]
    assert seconds_left(before, TOTALS, 15.0, 1, 1, 300) == pytest.approx(0.2 * 0.5 * 300)


def test_a_running_stage_has_its_own_pace() -> None:
    before = [StageRecord("teacher forcing", 30, 0.1, 6.0)]
    assert seconds_left(before, TOTALS, 10.0, 5, 60, 0) == pytest.approx(0.5 * 2.0 * 55)
