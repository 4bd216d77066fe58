"""Where a profile's points lie: close to where the deviance crosses its threshold, also where it is no parabola."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gbspec.training.profile.side import Side

MOST = 6


def walked(root: Callable[[float], float]) -> tuple[float, int]:
    """The crossing by a straight line between the last two places that enclose it, and the number of places."""
    side, number = Side(), 0
    while number < MOST and not side.complete:
        place, number = side.next, number + 1
        side.tell(place, root(place))
    assert side.outside is not None
    (a, low), (b, high) = side.inside, side.outside
    return a + (1 - low) / (high - low) * (b - a), number


@pytest.mark.parametrize("end", [0.3, 0.5, 0.8, 1.0, 1.5, 2.5])
@pytest.mark.parametrize(
    ("shape", "power"), [("parabola", 1.0), ("flat bottom", 2.0), ("flatter bottom", 3.0), ("bent down", 0.6)]
)
def test_the_crossing_is_found_within_a_few_per_cent(end: float, shape: str, power: float) -> None:
    found, number = walked(lambda place: (place / end) ** power)
    assert found == pytest.approx(end, rel=0.05), shape
    assert number <= MOST


def test_a_parabola_needs_two_points_where_its_deviation_is_known() -> None:
    found, number = walked(lambda place: place)
    assert (found, number) == (pytest.approx(1.0), 2)


@pytest.mark.parametrize("end", [0.3, 0.75])
def test_a_jump_is_enclosed(end: float) -> None:
    found, number = walked(lambda place: 0.2 if place < end else 30.0)
    assert found == pytest.approx(end, rel=0.25)
    assert number <= MOST
