"""What packing promises, for random tables."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gbspec.data.signals import evaluate
from gbspec.data.trajectories import Signal, Trajectories
from gbspec.training.problem.packing import default_max_step, pack
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, trajectory, urp_data

MODEL = model_of(URP)
WITH_INPUTS = model_of(EVERYTHING)

gaps = st.lists(st.floats(1e-3, 5.0), min_size=1, max_size=12)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(gaps, min_size=1, max_size=4), st.floats(0.01, 3.0), st.floats(-2, 2), st.booleans(), st.integers(0, 99)
)
def test_invariants(rows: list[list[float]], max_step: float, start: float, at_start: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    items = []
    for i, differences in enumerate(rows):
        times = start + np.cumsum([0.0, *differences])[0 if at_start else 1 :]
        values = rng.uniform(0, 1, (len(times), 2))
        values[rng.random(values.shape) < 0.3] = np.nan
        items.append(trajectory(str(i), start, times, values, [0.3]))
    data = Trajectories(tuple(items), ("x1", "x2"))
    for draw in (None, np.random.default_rng(seed)):
        packed = pack(data, MODEL, max_step, draw)
        assert packed.h.max() <= max_step * (1 + 1e-9)
        assert packed.rows == sum(len(item.times) for item in items)
        for i, item in enumerate(items):
            mine = packed.row_trajectory == i
            steps = int(packed.steps[i])
            h = packed.h[:, i]
            assert (h[:steps] > 0).all() and not h[steps:].any(), "steps of length zero stand at the end only"
            reached = start + np.concatenate([[0.0], np.cumsum(h)])
            assert np.allclose(reached[packed.row_step[mine]], item.times, rtol=1e-12, atol=1e-12)
            assert np.allclose(packed.t[:steps, i], reached[:steps], rtol=1e-12, atol=1e-12)
            assert np.array_equal(packed.values[mine], item.values, equal_nan=True)
            assert np.array_equal(packed.weights[mine] > 0, np.isfinite(item.values))


def test_breakpoints_of_inputs_are_step_boundaries() -> None:
    data = everything_data()
    packed = pack(data, WITH_INPUTS, 0.5)
    for i, item in enumerate(data.items):
        n = int(packed.steps[i])
        boundaries = np.append(packed.t[:n, i], packed.t[n - 1, i] + packed.h[n - 1, i])
        for signal in item.inputs:
            inside = signal.times[(signal.times > item.start) & (signal.times < item.end)]
            assert all(np.abs(boundaries - t).min() < 1e-12 for t in inside)
        held = packed.inputs[:n, i, :, 0]
        assert (held == held[:, :1]).all(), "a held input does not change within a step"
        t = packed.t[:n, i]
        assert np.allclose(packed.inputs[:n, i, 0, 1], evaluate(item.inputs[1], "linear", t, "right"))


def test_held_input_takes_the_right_limit_at_a_jump() -> None:
    signal = Signal(np.array([0.0, 1.0]), np.array([5.0, 7.0]))
    times = np.array([-1.0, 0.5, 1.0, 2.0])
    assert evaluate(signal, "held", times, "right").tolist() == [5.0, 5.0, 7.0, 7.0]
    assert evaluate(signal, "held", times, "left").tolist() == [5.0, 5.0, 5.0, 7.0]


def test_random_substeps_differ_and_end_in_the_same_place() -> None:
    data = urp_data(3, 2.0, 1)
    first, second = (pack(data, MODEL, 0.1, np.random.default_rng(seed)) for seed in (1, 2))
    assert not np.array_equal(first.h[:10], second.h[:10])
    assert np.allclose(first.h.sum(axis=0), second.h.sum(axis=0), rtol=1e-12)


def test_taking_some_trajectories() -> None:
    packed = pack(urp_data(4, 2.0, 1), MODEL, 0.1)
    part = packed.take([2, 0, 2])
    assert part.trajectories == 3 and part.depth == int(packed.steps[[2, 0]].max())
    for new, old in enumerate((2, 0, 2)):
        mine, theirs = part.row_trajectory == new, packed.row_trajectory == old
        assert np.array_equal(part.row_time[mine], packed.row_time[theirs])
        assert np.array_equal(part.values[mine], packed.values[theirs], equal_nan=True)


def test_default_step_follows_the_channels_own_intervals() -> None:
    times = np.arange(1, 41) * 0.25
    values = np.full((40, 2), 0.5)
    values[::2, 0] = np.nan
    values[1::2, 1] = np.nan
    data = Trajectories((trajectory("a", 0.0, times, values, [0.3]),), ("x1", "x2"))
    assert default_max_step(data) == pytest.approx(0.1)


def test_measurements_at_nearly_the_same_time_tell_nothing_of_the_step() -> None:
    """Three replicates a tenth of a second apart, each hour: the default step was a fiftieth of a second."""
    times = (np.arange(20)[:, None] + np.arange(3) / 3600 / 10).ravel()
    data = Trajectories((trajectory("a", 0.0, times, np.full((60, 1), 0.5), []),), ("x1",))
    assert default_max_step(data) == pytest.approx(0.2)
    spaced = np.logspace(-6, 4, 41)
    data = Trajectories((trajectory("a", 0.0, spaced, np.full((41, 1), 0.5), []),), ("x1",))
    assert default_max_step(data) == pytest.approx(np.median(np.diff(spaced)) / 5, rel=0.5)


def test_very_long_and_very_short_intervals() -> None:
    times = np.array([1e-9, 1e-3, 1.0, 1e5])
    data = Trajectories((trajectory("a", 0.0, times, np.full((4, 2), 0.5), [0.3]),), ("x1", "x2"))
    packed = pack(data, MODEL, 1e3)
    assert packed.substeps == 1 + 1 + 1 + 100
    assert packed.h.sum() == pytest.approx(1e5, rel=1e-12)


@pytest.mark.parametrize("drawn", [False, True])
def test_many_steps_end_before_a_jump(drawn: bool) -> None:
    """The rounding errors of their lengths add up to more than the distance that a step keeps from a jump."""
    model = model_of("model m\ntime t from 0\nlearn k = 1\nstate x in [0, 2]\nx' = floor(t/81.3) - k*x\nobserve x\n")
    data = Trajectories((trajectory("a", 0.0, np.array([0.0, 90.1]), np.ones((2, 1)), []),), ("x",))
    for step in np.linspace(0.01, 0.3, 40):
        packed = pack(data, model, step, np.random.default_rng(0) if drawn else None)
        n = int(packed.steps[0])
        t, h = packed.t[:n, 0], packed.h[:n, 0]
        assert (np.floor(t / 81.3) == np.floor((t + h) / 81.3)).all()
        assert h.min() > 0 and abs(h.sum() - 90.1) < 1e-9


def test_right_sides_do_not_jump_within_a_step() -> None:
    """Also where a measurement is made at the time of the jump, up to rounding, and where the trajectory ends."""
    text = "model m\ntime t from 0\nconst width = 0.7\nlearn k = 1\nlearn late = 2\nstate x in [0, 2]\n"
    model = model_of(text + "x' = if(mod(t, 2.4) <= width or t > late, 1, ceil(t/3)) - k*x\nobserve x\n")
    times = np.array([0.5, 0.7 + 1e-15, 2.4, 3.1, 6.0, 24 - 0.0, 24.7])
    data = Trajectories((trajectory("a", 0.0, times, np.ones((7, 1)), []),), ("x",))
    packed = pack(data, model, 0.5)
    n = int(packed.steps[0])
    t, h = packed.t[:n, 0], packed.h[:n, 0]
    inside = t[:, None] + np.array([0.0, 0.5, 1.0]) * h[:, None]
    for value in (inside - 2.4 * np.floor(inside / 2.4) <= 0.7, np.ceil(inside / 3)):
        assert (value == value[:, 1:2]).all()
    assert np.allclose(t[1:], t[:-1] + h[:-1], rtol=0, atol=1e-13), "what is left out is rounding"
    assert not np.isclose(t, 2.0).any(), "what is learned moves during the fit"
