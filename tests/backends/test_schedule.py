"""Steps end where right sides jump at times of their own, in solutions of both kinds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir import Model, insets, scheduled, switching_times

TEXT = """model clock
time t from 0
condition late in [0, 5]
learn k = 2 in [0.1, 5]
const width = 0.5
state x
x' = {} - k*x
initial x = 0.2
observe x
"""
PULSES = "if(mod(t - late, 24) < width, 1, 0)"


def model_of(right: str) -> Model:
    return load_model("model.gb", Findings(), lambda path: Source(str(path), TEXT.format(right)))


def pulses(times: np.ndarray, late: float, width: float) -> np.ndarray:
    """The solution with pulses, in closed form from one jump to the next."""
    jumps = [late + 24 * i + end for i in range(-1, 12) for end in (0.0, width)]
    found, x, before = {}, 0.2, 0.0
    for time in sorted({*map(float, times), *(j for j in jumps if j > 0)}):
        level = 0.5 if (0.5 * (time + before) - late) % 24 < width else 0.0
        x, before = level + (x - level) * np.exp(-2 * (time - before)), time
        found[time] = x
    return np.array([found[float(time)] for time in times])


@pytest.mark.parametrize("late", [0.0, 1.5, 3.0])
@pytest.mark.parametrize("width", [0.05, 0.5, 8.0])
@pytest.mark.parametrize("dt", [1.0, 12.0])
def test_no_pulse_is_passed_over(late: float, width: float, dt: float) -> None:
    """CVODES takes steps of several hours where nothing changes."""
    evaluator, times = Evaluator(load_module(model_of(PULSES))()), np.arange(0.0, 241.0, dt)
    given = {"condition": [late], "constants": [width, 2.0]}
    found = evaluator.integrate([0.2], times, **given)[:, 0]
    np.testing.assert_allclose(found, pulses(times, late, width), atol=1e-9)


def test_equal_steps_keep_the_order_of_the_method() -> None:
    evaluator, times = Evaluator(load_module(model_of(PULSES))()), np.arange(0.0, 97.0, 1.0)
    known = pulses(times, 1.5, 0.5)
    errors = [
        np.abs(evaluator.integrate_fixed([0.2], times, [1.5], max_step=step)[:, 0] - known).max()
        for step in (0.25, 0.125)
    ]
    assert errors[0] < 2e-4
    assert errors[0] / errors[1] > 12


@pytest.mark.parametrize(
    ("right", "wanted"),
    [
        ("if(t > 3, 1, 0)", [3.0]),
        ("floor(t/4)", [0.0, 4.0, 8.0]),
        ("ceil(t/4 - 0.5)", [2.0, 6.0, 10.0]),
        ("sign(t - width)", [0.5]),
        (PULSES, [1.0, 1.5]),
        ("if(mod(t, 5) > 2, floor(t/7), 0)", [0.0, 2.0, 5.0, 7.0, 10.0]),
        ("if(mod(mod(t, 6), 4) < 1, 1, 0)", [0.0, 1.0, 4.0, 5.0, 6.0, 7.0, 10.0]),
        ("if(x > 3 and k > 1, floor(x), late)", []),
        ("if(sin(t) > 0, 1, 0)", []),
    ],
)
def test_times_at_which_right_sides_jump(right: str, wanted: list[float]) -> None:
    model = model_of(right)
    instance = load_module(model)()
    assert bool(scheduled(model)) == hasattr(instance.equations, "schedule")
    found = Evaluator(instance)._switches(0.0, 10.0, [1.0], None)
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_what_a_network_decides_is_left_alone() -> None:
    text = TEXT.format("if(f(t) > 0, 1, 0)").replace("observe x", "unknown f(t) by mlp(4)\nobserve x")
    model = load_model("model.gb", Findings(), lambda path: Source(str(path), text))
    assert not scheduled(model)
    assert np.isfinite(Evaluator(load_module(model).random(1)).integrate([0.2], [0.0, 1.0], [0.0])).all()


def test_far_too_many_times_are_left_alone() -> None:
    instance = load_module(model_of("floor(1000*t)"))()
    assert len(Evaluator(instance)._switches(0.0, 1.0, [0.0], None)) == 1001
    assert len(Evaluator(instance)._switches(0.0, 100.0, [0.0], None)) == 0


@settings(max_examples=100, deadline=None)
@given(
    st.floats(0.1, 30.0),
    st.floats(0.01, 0.99),
    st.floats(-5.0, 5.0),
    st.floats(0.5, 100.0),
)
def test_all_times_are_found(period: float, share: float, start: float, length: float) -> None:
    """Between them and away from them, nothing jumps."""

    def values(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return t / period, t - period * np.floor(t / period) - share * period

    found = switching_times(values, (True, False), start, start + length)
    edges, away = insets(np.array([start, start + length]), found, 1e-9 * max(length, abs(start + length)))
    for a, b, first, last in zip(edges[:-1], edges[1:], away[:-1], away[1:], strict=True):
        whole, difference = values(np.array([a + first, 0.5 * (a + b), b - last]))
        assert len(set(np.floor(whole))) == 1
        assert len(set(difference < 0)) == 1
