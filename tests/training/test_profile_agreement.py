"""A profile beside the interval of the fit: which one to trust."""

from __future__ import annotations

import pytest

from gbspec.training.profile.agreement import Comparison, Found, compared

FIT = (0.74, 0.88)


def judged(
    low: float | None, high: float | None, best: float = 0.81, *, settled: bool = True, members: int = 1
) -> Comparison:
    return compared(Found(best, low, high, settled), 0.81, FIT, members)


def test_intervals_that_agree_say_nothing() -> None:
    assert judged(0.75, 0.89) == Comparison("both")


@pytest.mark.parametrize("ends", [(0.74, 0.98), (0.60, 0.88), (0.79, 0.83), (0.81, 0.95)])
def test_an_end_further_off_than_a_third_means_the_profile(ends: tuple[float, float]) -> None:
    found = judged(*ends)
    assert found.trust == "profile" and "trust the profile" in found.words and "0.74 to 0.88" in found.words
    assert "not that of the fit" not in found.words


def test_another_best_value_is_told() -> None:
    found = judged(0.75, 0.98, best=0.86)  # hare_lynx's m
    assert found.trust == "profile" and "its best value, 0.86, is not that of the fit, 0.81" in found.words


def test_an_open_end_means_the_profile() -> None:
    found = judged(None, 0.88)
    assert found.trust == "profile" and "open to 0.88" in found.words


def test_fits_that_did_not_converge_refute_nothing() -> None:
    assert judged(None, None, settled=False).trust == "fit"
    assert compared(Found(0.8, None, None, False), 0.8, None, 1).trust == "neither"


def test_the_only_interval_is_trusted() -> None:
    found = compared(Found(0.8, 0.7, 0.9, True), 0.8, None, 1)
    assert found.trust == "profile" and "0.7 to 0.9" in found.words


def test_a_profile_of_one_member_does_not_have_the_differences_between_members() -> None:
    assert judged(0.79, 0.83, members=3).trust == "fit"
    assert judged(0.60, 0.95, members=3).trust == "profile"


@pytest.mark.parametrize("settled", [True, False])
@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("fit", [(0.2, 1.4), (0.805, 0.815), None])
def test_a_profile_that_a_raised_prior_narrows_is_not_trusted(
    fit: tuple[float, float] | None, members: int, settled: bool
) -> None:
    found = compared(Found(0.81, 0.80, 0.82, settled, 0.915), 0.81, fit, members)
    assert found.trust == "neither" and "the raised prior of the weights makes 92 % narrower" in found.words
    assert found.words.startswith("trust neither the profile, ") and "hardly determine" in found.words
    assert ("0.8 to 0.82" in found.words) == settled


def test_a_little_narrowing_changes_nothing() -> None:
    narrowed = compared(Found(0.81, 0.60, 0.88, True, 0.1), 0.81, FIT, 1)
    assert narrowed == compared(Found(0.81, 0.60, 0.88, True), 0.81, FIT, 1)
