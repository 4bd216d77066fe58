"""Stiff solvers and adaptive steps with events: they end just after them, with exact derivatives and full order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.backends import Evaluator, load_module
from gbspec.backends.casadi import events
from gbspec.data.trajectories import Trajectories
from gbspec.ir import METHODS
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.engine import Engine
from gbspec.training.engines.objective import linearise, residual_table, residual_vector
from gbspec.training.options import TrainOptions
from gbspec.training.problem.mesh import Control
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from gbspec.training.recipe.stiffness import chosen_solver
from tests.events.models import BALL, MIXED, THERMOSTAT
from tests.events.test_derivatives import mixed_rows, some_rows
from tests.events.test_kernel import DROPPED, dropped, engines_of, the_kernel_agrees
from tests.training.conftest import model_of, problem_of, trajectory
from tests.training.reference import whole_jacobian

RELAY = """model relay "A thermostat whose sensor is fast, and whose heater too"
time t from 0
state T in [10, 30]
state s in [10, 30]
state p in [0, 6]
discrete on = 1
learn low = 18.2 in [15, 20]
learn high = 21.8 in [20, 25]
learn k = 0.27 in [0.05, 1]
T' = k*(8 - T) + p
s' = 5e4*(T - s)
p' = if(on > 0, 2e3, 30)*(6*on - p)
initial T = 15
initial s = 15
initial p = 6
event start when s <= low: on = 1
event stop when s >= high: on = 0
observe T
truth low = 18
truth high = 22
truth k = 0.25
"""
CASES = {"ball": (BALL, 3.0), "thermostat": (THERMOSTAT, 8.0), "relay": (RELAY, 8.0), "mixed": (MIXED, 0.0)}


def case(name: str, method: str, rtol: float | None, step: float = 10.0) -> tuple[Problem, Parameters, Array]:
    text, span = CASES[name]
    model = model_of(text)
    data = some_rows(len(model.channels), 10, span) if span else mixed_rows().subset([0])
    problem, parameters, theta = problem_of(model, data, step, blend=0.0, method=METHODS[method])
    control = None if rtol is None else Control(rtol, np.ones(len(model.states)))
    return replace(problem, control=control), parameters, theta


@pytest.mark.parametrize("method", ["ros34pw2", "dopri5"])
@pytest.mark.parametrize("name", ["ball", "thermostat", "mixed"])
def test_kernel_and_graph_choose_the_same_steps_and_agree(name: str, method: str) -> None:
    problem, parameters, theta = case(name, method, 1e-4)
    graph, kernel = (engine.plan(theta).packed for engine in engines_of(problem, parameters))
    assert np.array_equal(graph.steps, kernel.steps)
    assert np.abs(graph.t - kernel.t).max() < 1e-9
    the_kernel_agrees(problem, parameters, theta)


def test_they_agree_where_the_equations_are_stiff(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, parameters, theta = case("relay", "ros34pw2", 1e-4)
    graph, kernel = engines_of(problem, parameters)
    path = kernel.plan(theta)
    assert path.packed.steps[0] < 2000, "steps far beyond the limit of explicit methods"
    assert np.abs(graph.moments(theta, path).mean - kernel.moments(theta, path).mean).max() < 1e-9
    monkeypatch.setattr(Paths, "at", lambda *_: path)
    whole, ours = (linearise(engine, theta).shared for engine in (graph, kernel))
    assert float((whole - ours).abs().max()) <= 1e-8 * float(whole.abs().max())


def slopes_along(engine: Engine, theta: Array, direction: Array, h: float) -> tuple[Array, Array]:
    """The derivative of residuals along a direction, and central differences of order four."""
    jacobian = whole_jacobian(linearise(engine, theta), engine.parameters).numpy()
    total = np.zeros(len(jacobian))
    for weight, s in ((8, 1), (-1, 2)):
        ahead, behind = (residual_vector(engine, theta + sign * s * h * direction) for sign in (1, -1))
        total += weight * (ahead - behind)
    return jacobian @ direction, total / (12 * h)


@pytest.mark.parametrize(
    ("name", "method"),
    [*((name, "ros34pw2") for name in ("ball", "thermostat", "relay")), ("ball", "dopri5"), ("thermostat", "dopri5")],
)
def test_derivatives_are_those_of_the_steps_taken(name: str, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On steps that were planned at another vector, so that events lie anywhere within them; not by an explicit method
    where the model is stiff."""
    problem, parameters, theta = case(name, method, 1e-3)
    engine = engines_of(problem, parameters)[1]
    path = engine.plan(theta)
    monkeypatch.setattr(Paths, "at", lambda *_: path)
    rng = np.random.default_rng(3)
    there = theta + 1e-3 * rng.standard_normal(len(theta))
    exact, expected = slopes_along(engine, there, rng.standard_normal(len(theta)), 1e-6)
    assert np.abs(exact - expected).max() < 3e-8 * np.abs(expected).max()


@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_solutions_are_within_the_tolerance(rtol: float) -> None:
    problem, parameters, theta = case("relay", "ros34pw2", rtol)
    engine = engines_of(problem, parameters)[1]
    exact = engine.rebound(replace(problem, control=Control(1e-8, np.ones(4))), parameters)
    found, expected = (each.moments(theta, each.plan(theta)).mean for each in (engine, exact))
    assert np.abs(found - expected).max() < 50 * rtol


@pytest.mark.parametrize("name", ["thermostat", "mixed"])
def test_the_method_keeps_its_order_through_events(name: str) -> None:
    def means(step: float) -> Array:
        problem, parameters, theta = case(name, "ros34pw2", None, step)
        engine = engines_of(problem, parameters)[1]
        return engine.moments(theta, engine.plan(theta)).mean

    coarse, fine, finest = (means(step) for step in (0.04, 0.02, 0.004))
    assert np.abs(coarse - finest).max() > 6 * np.abs(fine - finest).max() > 0


@pytest.mark.parametrize("method", ["ros34pw2", "dopri5"])
def test_a_ball_that_comes_to_rest_is_told(method: str) -> None:
    problem, parameters, theta = problem_of(
        model_of(DROPPED), dropped([5.0, 60.0], 5.5), 10.0, blend=0.0, method=METHODS[method]
    )
    problem = replace(problem, control=Control(1e-6, np.ones(3)))
    theta = parameters.vector(parameters.natural(theta), np.array([0.52, 12.0]))
    rest = 1.52 / 0.48 * np.sqrt(2 * 5.0 / 12.0)
    packed = problem.packed
    ends = (packed.row_trajectory == 0) & (packed.row_time > rest)
    assert ends.any()
    graph, kernel = engines_of(problem, parameters)
    for engine in (graph, kernel):
        table = residual_table(engine, theta)
        assert np.isnan(table[ends]).all() and np.isfinite(table[~ends]).all()
    happened = kernel.happened(theta, kernel.plan(theta))  # type: ignore[attr-defined]
    assert happened.endless.tolist() == [1, 0]


def test_a_stiff_model_with_events_gets_the_stiff_solver() -> None:
    model = model_of(RELAY)
    times = np.linspace(0.2, 6.0, 25)
    values = 20 + 2 * np.sin(times)[:, None]
    data = Trajectories((trajectory("1", 0.0, times, values, []),), ("T",))
    name, reason = chosen_solver(model, load_module(model), data, TrainOptions())
    assert name == "ros34pw2" and reason is not None and "the equations are stiff" in reason


def test_simulated_solutions_of_stiff_equations_are_implicit(monkeypatch: pytest.MonkeyPatch) -> None:
    """An explicit method would take half a million evaluations."""
    evaluator, calls, plain = Evaluator(load_module(model_of(RELAY)).random(0)), [0], events._Trajectory.rate

    def counted(self: events._Trajectory, time: float, state: Array) -> Array:
        calls[0] += 1
        return plain(self, time, state)

    monkeypatch.setattr(events._Trajectory, "rate", counted)
    found = evaluator.integrate([15.0, 15.0, 6.0, 1.0], np.linspace(0.0, 8.0, 5), rtol=1e-6)
    assert np.isfinite(found).all() and 100 < calls[0] < 50_000
