"""The casadi evaluator compared with closed-form and published solutions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.data.trajectories import DoseEvents, Signal
from gbspec.diagnostics import ComputationError
from gbspec.ir.model import Channel, Condition, Constant, Dose, Input, Learnable, Model, State, symbol
from tests.backends.examples import clinic, reactor


def evaluator(*balances: Any, **parts: Any) -> Evaluator:
    """A model without unknowns in the states x, y, z (one per balance)."""
    states = tuple(State(name) for name in "xyz"[: len(balances)])
    channels = (Channel("x", value=symbol("x"), state=0),)
    return Evaluator(load_module(Model(name="known", states=states, balances=balances, channels=channels, **parts))())


x, y, z, u, a, t = map(symbol, ("x", "y", "z", "u", "a", "t"))


def test_exponential_decay_to_the_tolerance() -> None:
    decay = evaluator(-a * x, constants=(Constant("a", value=2.0),))
    times = np.linspace(0.0, 5.0, 11)
    found = decay.integrate([3.0], times)
    assert found.shape == (11, 1)
    assert found[:, 0] == pytest.approx(3.0 * np.exp(-2 * times), rel=1e-9, abs=1e-10)
    other = decay.integrate([3.0], times, constants=[1.0])
    assert other[:, 0] == pytest.approx(3.0 * np.exp(-times), rel=1e-9)


def test_scales_of_states_do_not_matter() -> None:
    tiny = evaluator(-x, -y)
    found = tiny.integrate([1e-9, 1e9], [0.0, 1.0])[-1]
    assert found == pytest.approx([1e-9 * np.exp(-1), 1e9 * np.exp(-1)], rel=1e-9)


def test_time_and_the_start_before_the_first_output() -> None:
    clock = evaluator(2 * t)
    found = clock.integrate([1.0], [1.0, 2.0, 2.5], start=-1.0)
    assert found[:, 0] == pytest.approx([1.0, 4.0, 6.25], rel=1e-9)
    assert clock.integrate([7.0], [3.0]).tolist() == [[7.0]]


def test_a_power_of_a_negative_state_with_a_named_exponent() -> None:
    """Its derivative by the exponent, which nothing needs, has the logarithm of the state."""
    named = evaluator(1 - (x / 2) ** a, constants=(Constant("a", value=4.0),))
    number = evaluator(1 - (x / 2) ** 4)
    times = np.linspace(0.0, 3.0, 7)
    assert named.integrate([-0.1], times) == pytest.approx(number.integrate([-0.1], times), rel=1e-9)


SIGNAL = Signal(np.array([0.5, 1.0, 2.0]), np.array([1.0, 3.0, 0.0]))


@pytest.mark.parametrize(
    ("kind", "wanted"),
    [
        ("held", lambda s: min(s, 1.0) + 3 * min(max(s - 1.0, 0.0), 1.0)),
        (
            "linear",
            lambda s: (
                min(s, 0.5) + float(np.interp(min(s, 2.0), [0.5, 1, 2], [0, 1, 2.5])) if s in (0.5, 1, 2, 3) else None
            ),
        ),
    ],
)
@pytest.mark.parametrize("method", ["cvodes", "fixed"])
def test_inputs_are_integrated_exactly(kind: Any, wanted: Callable[[float], float], method: str) -> None:
    tank = evaluator(u, inputs=(Input("u", interpolation=kind),))
    times = [0.5, 1.0, 2.0, 3.0]
    if method == "cvodes":
        found = tank.integrate([0.0], times, inputs=(SIGNAL,), start=0.0)
    else:
        found = tank.integrate_fixed([0.0], times, inputs=(SIGNAL,), start=0.0, max_step=10.0)
    assert found[:, 0] == pytest.approx([wanted(s) for s in times], rel=1e-9)


@pytest.mark.parametrize("method", ["cvodes", "fixed"])
def test_doses_arrive_after_the_measurement_with_fraction_and_lag(method: str) -> None:
    patient = evaluator(sympy.S.Zero, constants=(Constant("a", value=0.25),), doses=(Dose("x", fraction=a, lag=2 * a),))
    events = DoseEvents(np.array([0.0, 1.0]), np.array([8.0, 4.0]))
    times = [0.0, 0.5, 0.75, 1.5, 2.0]
    options = {"max_step": 0.3} if method == "fixed" else {}
    run = patient.integrate_fixed if method == "fixed" else patient.integrate
    assert run([0.0], times, doses=(events,), **options)[:, 0] == pytest.approx([0.0, 0.0, 2.0, 2.0, 3.0])


def test_stiff_problems_switch_to_bdf() -> None:
    """Robertson's kinetics; the reference is that of Hairer and Wanner, Solving ODEs II, at t = 40."""
    robertson = evaluator(-0.04 * x + 1e4 * y * z, 0.04 * x - 1e4 * y * z - 3e7 * y**2, 3e7 * y**2)
    found = robertson.integrate([1.0, 0.0, 0.0], [0.0, 40.0], scales=[1.0, 1e-5, 1.0])[-1]
    assert found == pytest.approx([0.7158270688, 9.185534765e-6, 0.2841637457], rel=1e-8)


def test_a_blow_up_reports_time_and_state() -> None:
    explosion = evaluator(x**2)
    with pytest.raises(ComputationError) as caught:
        explosion.integrate([1.0], [0.0, 0.25, 0.5, 0.75, 1.5])
    assert caught.value.where == "after t = 0.75, where x = 4"
    assert caught.value.remedy


def test_an_initial_state_that_is_not_finite_is_rejected() -> None:
    with pytest.raises(ComputationError, match="initial state"):
        evaluator(-x).integrate([np.nan], [0.0, 1.0])


@pytest.mark.parametrize("times", [[], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan]])
def test_times_must_increase(times: list[float]) -> None:
    with pytest.raises(ValueError, match="increase"):
        evaluator(-x).integrate([1.0], times)


def test_counts_of_inputs_and_doses_are_checked() -> None:
    with pytest.raises(ValueError, match="0 inputs, 1"):
        evaluator(-x).integrate([1.0], [0.0, 1.0], inputs=(SIGNAL,))
    with pytest.raises(ValueError, match="0 doses, 1"):
        evaluator(-x).integrate([1.0], [0.0, 1.0], doses=(DoseEvents(np.zeros(1), np.zeros(1)),))
    with pytest.raises(ValueError, match="before the start"):
        evaluator(-x).integrate([1.0], [0.0, 1.0], start=0.5)


def test_rk4_is_of_fourth_order() -> None:
    pendulum = evaluator(y, -sympy.sin(x))
    exact = pendulum.integrate([1.0, 0.0], [0.0, 2.0, 5.0])
    errors = [
        np.abs(pendulum.integrate_fixed([1.0, 0.0], [0.0, 2.0, 5.0], max_step=h) - exact).max() for h in (0.1, 0.05)
    ]
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.1)


def test_a_network_is_integrated_like_any_other_function() -> None:
    network = Evaluator(load_module(reactor()).random(0))
    times = np.linspace(0.0, 10.0, 21)
    found = network.integrate([0.3, 1.2], times, [0.3])
    reference = solve_ivp(
        lambda s, v: network.rhs_many(s, v, [0.3])[0], (0.0, 10.0), [0.3, 1.2], "DOP853", times, rtol=1e-13, atol=1e-14
    )
    assert np.abs(found - reference.y.T).max() < 1e-10


def test_many_points_agree_with_single_points() -> None:
    model = Evaluator(load_module(clinic()).random(1))
    generator = np.random.default_rng(0)
    times, states, inputs = generator.uniform(size=9), generator.uniform(size=(9, 3)), generator.uniform(size=(9, 1))
    constants = generator.uniform(size=(9, 2))
    rhs = model.rhs_many(times, states, inputs=inputs, constants=constants)
    observed = model.observe_many(times, states, inputs=inputs, constants=constants)
    assert (rhs.shape, observed.shape) == ((9, 3), (9, 2))
    for i in range(9):
        known = (times[i], states[i], (), inputs[i], constants[i])
        assert rhs[i] == pytest.approx(model.rhs_many(*known)[0], rel=1e-14)
        h = np.array(model.function("h")(states[i][[0, 2]], constants[i]))
        assert model.functions_many("h", states[i][[0, 2]], constants[i]) == pytest.approx(h.ravel(), rel=1e-14)
    assert model.rhs_many(0.0, states, inputs=[0.5]).shape == (9, 3)


def test_jacobian_by_differences() -> None:
    model = Evaluator(load_module(reactor()).random(2))
    at, h = np.array([0.3, 1.2]), 1e-5
    differences = [
        (model.rhs_many(0.0, at + step, [0.3]) - model.rhs_many(0.0, at - step, [0.3]))[0] / (2 * h)
        for step in h * np.eye(2)
    ]
    assert model.jacobian_at(0.0, at, [0.3]) == pytest.approx(np.array(differences).T, rel=1e-8)


def test_casadi_functions_take_symbols() -> None:
    """Continuation needs the constants as a further input, and derivatives with respect to any input."""
    model = evaluator(-a * x + u, conditions=(Condition("u"),), learnables=(Learnable("a", start=2.0),))
    arguments = model.rhs.mx_in()
    by_constants = casadi.Function("d", arguments, [casadi.jacobian(model.rhs(*arguments), arguments[4])])
    assert float(by_constants(0.0, 3.0, 1.0, [], 2.0)) == -3.0
    symbolic = casadi.SX.sym("s")
    assert casadi.which_depends(model.rhs(0.0, symbolic, 1.0, casadi.SX(0, 1), 2.0), symbolic) == [True]


@pytest.mark.parametrize("start", [0.0, 1e-300, 5e-151, 1e-100, 1e-30, 1e-12])
def test_a_remainder_of_a_state_is_no_scale(start: float) -> None:
    rate = x / (0.1 + x) * y
    found = evaluator(-1.6 * rate, 0.8 * rate).integrate([start, 1.0], np.linspace(0, 10, 5), rtol=1e-8, atol=1e-8)
    assert found[-1, 1] == pytest.approx(1.0)
    assert 0 <= abs(found[-1, 0]) <= start


@pytest.mark.parametrize("off", [-1e-12, 0.0, 1e-12])
@pytest.mark.parametrize("method", ["cvodes", "fixed"])
def test_a_dose_within_rounding_of_a_row_comes_after_it(method: str, off: float) -> None:
    given = evaluator(-x, doses=(Dose("x"),))
    doses = (DoseEvents(np.array([0.0 + off, 2.0 + off, 4.0 + off]), np.array([1.0, 10.0, 100.0])),)
    step = {"max_step": 0.01} if method == "fixed" else {}
    solve = given.integrate_fixed if method == "fixed" else given.integrate
    found = solve([1.0], [0.0, 1.0, 2.0, 3.0, 4.0], doses=doses, **step)[:, 0]  # type: ignore[operator]
    before = 2 * np.exp(-2.0)
    np.testing.assert_allclose(found, [1.0, 2 * np.exp(-1.0), before, (before + 10) * np.exp(-1.0),
                                       (before + 10) * np.exp(-2.0)], rtol=1e-7)  # fmt: skip
