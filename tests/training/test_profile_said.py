"""What a profile says of better fits than the run's, and of bounds of other constants."""

from __future__ import annotations

from gbspec.training.profile.result import ProfilePoint
from gbspec.training.profile.said import said_of_better, said_of_bounds
from tests.training.conftest import model_of

MODEL = model_of(
    "model m\nstate x in [0, 10] = 1\nlearn tau = 1 in [0.1, 10]\nlearn amp = 50 in [0, 100]\n"
    "x' = amp - x/tau\nobserve x\n"
)


def point(value: float, deviance: float, amp: float = 50.0) -> ProfilePoint:
    return ProfilePoint(value, deviance, {"amp": amp}, True)


def test_a_better_fit_than_the_run_is_told_with_its_values() -> None:
    assert said_of_better("tau", point(1.0, 0.3), point(1.1, 0.0)) == []
    (text,) = said_of_better("tau", point(1.0, 11.3), point(2.5, 0.0, 70.0))
    assert "the run's fit (tau = 1) is not the best one" in text and "lower by 11.3" in text
    assert "`tau = 2.5`, `amp = 70`" in text


def test_another_constant_at_its_bound_is_named_where_the_profile_meets_it() -> None:
    side = (point(1.2, 0.5, 90.0), point(1.6, 78.0, 100.0), point(2.0, 300.0, 100.0))
    (text,) = said_of_bounds(MODEL, "tau", {"amp": 60.0}, side)
    assert "at tau = 1.6" in text and "`amp` at its bound 100" in text
    assert said_of_bounds(MODEL, "tau", {"amp": 60.0}, side[:1]) == []
    assert said_of_bounds(MODEL, "tau", {"amp": 100.0}, side) == [], "it is there at the estimate already"
