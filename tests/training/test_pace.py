"""The time that a fit may still take is estimated by what its stages needed so far."""

from __future__ import annotations

import pytest

from gbspec.runs import StageRecord
from gbspec.training.runs.pace import seconds_left

TOTALS = {"warm start": 1, "teacher forcing": 60, "initial states": 1, "autoregressive": 60}
POPULATION = {"search": 8, "marginal likelihood": 200, "finer step": 200, "quadrature": 200}
KNOWN = {"search": 64, "least squares": 200}


def record(name: str, iterations: int, seconds: float) -> StageRecord:
    return StageRecord(name, iterations, 0.1, seconds)


def test_before_any_stage_of_several_iterations_the_typical_share_is_expected() -> None:
    """All of them were, and "about 31 min left" was said of a demo that takes two."""
    now, later = record("teacher forcing", 4, 2.0), ["initial states", "autoregressive"]
    assert seconds_left([record("warm start", 1, 9.0)], now, TOTALS, later) == pytest.approx(0.15 * 0.5 * 117)


def test_a_single_step_alone_tells_nothing() -> None:
    assert seconds_left([], record("warm start", 1, 1.5), TOTALS, ["teacher forcing"]) is None


def test_a_slow_single_step_says_nothing_of_iterations() -> None:
    """Refitting initial states took 15 s, and "at most 1 h 31 min left" was said of a fit of two minutes."""
    before = [record("warm start", 1, 9.0), record("teacher forcing", 12, 6.0)]
    left = seconds_left(before, record("initial states", 1, 15.0), TOTALS, ["autoregressive"])
    assert left == pytest.approx(0.2 * 0.5 * 60)


def test_a_running_stage_has_its_own_pace() -> None:
    left = seconds_left([record("teacher forcing", 30, 6.0)], record("autoregressive", 5, 10.0), TOTALS, [])
    assert left == pytest.approx(0.5 * 2.0 * 55)


def test_a_search_tells_nothing_of_a_likelihood() -> None:
    """Each iteration of a search is a whole fit: "about 2 h 25 min left" was said where a few minutes were."""
    assert seconds_left([], record("search", 2, 120.0), POPULATION, ["marginal likelihood"]) is None
    assert seconds_left([record("search", 4, 240.0)], record("marginal likelihood", 1, 2.0), POPULATION, []) is None
    assert seconds_left([record("search", 8, 80.0)], record("least squares", 2, 1.0), KNOWN, []) == pytest.approx(
        0.15 * 99
    )


def test_quadrature_and_a_finer_step_go_by_the_likelihood_before_them() -> None:
    before = [record("search", 4, 240.0), record("marginal likelihood", 20, 30.0)]
    for name in ("finer step", "quadrature"):
        assert seconds_left(before, record(name, 2, 10.0), POPULATION, []) == pytest.approx(0.1 * 5.0 * 198)


def test_the_likelihood_of_innovations_ends_by_itself() -> None:
    """Of the largest number, 150, a share had been expected to be left: the time left grew while the fit went on."""
    totals = {"warm start": 1, "innovations": 150}
    before = [record("warm start", 1, 9.0)]
    assert seconds_left(before, record("innovations", 10, 20.0), totals, []) == pytest.approx(60.0)
    assert seconds_left(before, record("innovations", 30, 60.0), totals, []) == pytest.approx(20.0)
    assert seconds_left(before, record("innovations", 41, 82.0), totals, []) is None
    assert seconds_left(before, record("innovations", 10, 20.0), totals, [], functions=True) is None
    assert seconds_left(before, record("innovations", 39, 78.0), {"innovations": 40}, []) == pytest.approx(2.0)
