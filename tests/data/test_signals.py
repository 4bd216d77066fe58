"""Values of inputs between their filled cells, and the limits at a jump."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gbspec.data.signals import clipped, evaluate
from gbspec.data.trajectories import Signal

STEPS = Signal(np.array([0.0, 1.0, 2.0, 3.0]), np.array([5.0, 7.0, 7.0, 4.0]))


def test_a_held_input_keeps_its_value() -> None:
    t = [-1.0, 0.0, 0.5, 1.0, 2.5, 3.0, 9.0]
    assert evaluate(STEPS, "held", t).tolist() == [5, 5, 5, 7, 7, 4, 4]


def test_a_jump_has_two_limits() -> None:
    assert evaluate(STEPS, "held", [1.0, 3.0], side="left").tolist() == [5, 7]
    assert evaluate(STEPS, "held", [1.0, 3.0], side="right").tolist() == [7, 4]
    assert evaluate(STEPS, "held", 0.0, side="left") == 5


def test_a_linear_input_is_interpolated() -> None:
    t = [-1.0, 0.5, 1.5, 2.5, 4.0]
    for side in ("left", "right"):
        assert evaluate(STEPS, "linear", t, side=side).tolist() == [5, 6, 7, 5.5, 4]  # type: ignore[arg-type]  # one of the two


def test_any_shape_of_times() -> None:
    assert evaluate(STEPS, "held", np.zeros((2, 3))).shape == (2, 3)
    assert evaluate(STEPS, "linear", 0.25).shape == ()


@pytest.mark.parametrize("interpolation", ["held", "linear"])
@given(
    times=st.lists(st.integers(0, 40), min_size=1, max_size=8, unique=True).map(sorted),
    seed=st.integers(0, 99),
    ends=st.tuples(st.integers(0, 45), st.integers(1, 10)),
)
def test_a_clipped_signal_says_the_same_within(
    interpolation: str, times: list[int], seed: int, ends: tuple[int, int]
) -> None:
    signal = Signal(np.array(times, float), np.random.default_rng(seed).normal(size=len(times)))
    start, end = ends[0] + 0.5, ends[0] + 0.5 + ends[1]
    part = clipped(signal, interpolation, start, end)  # type: ignore[arg-type]  # one of the two
    assert part.times[0] == start and part.times[-1] <= end and np.all(np.diff(part.times) > 0)
    t = np.linspace(start, end, 50)
    np.testing.assert_allclose(
        evaluate(part, interpolation, t),  # type: ignore[arg-type]
        evaluate(signal, interpolation, t),  # type: ignore[arg-type]
        atol=1e-12,
    )
