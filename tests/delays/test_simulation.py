"""Solutions of the evaluator, which shares only the equations with the module, beside other methods."""

from __future__ import annotations

import numpy as np
import torch

from gbspec.backends import Evaluator, load_module
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories
from gbspec.training.engines.choice import torch_engine
from tests.delays.models import EVERYTHING, MACKEY_GLASS, everything_data, mackey_glass
from tests.training.conftest import model_of, problem_of, trajectory


def test_the_evaluator_agrees_with_a_method_of_steps() -> None:
    module = load_module(model_of(MACKEY_GLASS))({"constants": np.array([17.0, 0.2, 0.1])})
    times, values = mackey_glass(17.0, 0.2, 0.1, 100.0, 0.02)
    found = Evaluator(module).integrate([0.5], times[::500])
    assert np.allclose(found[:, 0], values[::500], atol=1e-9)


def test_a_linear_delay_has_its_known_solution() -> None:
    model = model_of(
        "model m\ntime t from 0\nstate x\ncondition d in [0.5, 2]\nx' = -delay(x, d)\ninitial x = 1\nobserve x\n"
        "observe late = delay(x, d)"
    )
    module = load_module(model)()
    states, late = Evaluator(module).followed([1.0], [0.0, 0.5, 1.0, 1.5, 2.5], [1.0])
    exact = [1.0, 0.5, 0.0, -0.375, 1 - 2.5 + 1.5**2 / 2 - 0.5**3 / 6]
    assert np.allclose(states[:, 0], exact, atol=1e-9)
    assert np.allclose(late[:, 0], [1.0, 1.0, 1.0, 0.5, -0.375], atol=1e-9)


def test_engine_and_evaluator_agree_with_everything() -> None:
    data = everything_data()
    problem, parameters, theta = problem_of(model_of(EVERYTHING), data, 0.02, blend=0.0)
    engine = torch_engine(problem, parameters)
    moments = engine.moments(theta, engine.plan(theta))
    natural = parameters.natural(theta)
    module = type(problem.module)({k: v for k, v in natural.items() if k in type(problem.module).shapes()})
    evaluator = Evaluator(module)
    packed = problem.packed
    for i, item in enumerate(data.items):
        constants = natural["constants"].copy()
        constants[list(module.constants).index("r")] = natural["per_trajectory.r"][i]
        states, late = evaluator.followed(
            moments.initial[i], item.times, item.condition, item.inputs, 0.0, doses=item.doses, constants=constants
        )
        signal: Signal = item.inputs[0]
        inputs = np.interp(item.times, signal.times, signal.values)[:, None]
        seen = evaluator.observe_many(item.times, states, item.condition, np.hstack([inputs, late]), constants)
        mine = packed.row_trajectory == i
        assert np.allclose(moments.before[mine], states, atol=2e-6)
        assert np.allclose(moments.mean[mine], seen, atol=2e-6)
        assert isinstance(item.doses[0], DoseEvents)


def test_fixed_steps_of_the_evaluator_are_those_of_the_module() -> None:
    module = load_module(model_of(MACKEY_GLASS))({"constants": np.array([17.0, 0.2, 0.1])})
    times = [0.0, 8.0, 17.0, 30.0]
    fixed, halved = (Evaluator(module).integrate_fixed([0.5], times, max_step=1.0, parts=n) for n in (1, 2))
    own = module.simulate([0.5], times, max_step=1.0).numpy()
    assert np.allclose(fixed, own, atol=1e-13)
    assert 1e-10 < np.abs(fixed - halved).max() < 1e-5


def test_every_output_costs_about_one_step() -> None:
    """Steps go on with the length of those before an output, where nothing jumps, and do not begin with tiny ones."""
    evaluator = Evaluator(load_module(model_of(MACKEY_GLASS))({"constants": np.array([17.0, 0.2, 0.1])}))
    rates, rhs = [], evaluator.rhs

    def counted(time: float, *others: object) -> object:
        rates.append(time)
        return rhs(time, *others)

    evaluator.rhs = counted
    evaluator.integrate([0.5], np.linspace(0.0, 100.0, 201), rtol=1e-8, atol=1e-8)
    # A step and its dense output take 15 rates, what checks the first one of 206 stretches another.
    assert len(rates) < 1.3 * 16 * 206


ARRIVING = """model m
time t from 0
input u held
input v linear
condition c in [0.5, 4]
state y in [0, 5]
learn a = 0.6 in [0.05, 3]
learn tau = 1.37 in [0.5, 4]
y' = a*delay(u, tau) - 0.4*delay(y, c)*y + 0.2*delay(v, tau)
history y = 0.8
initial y = 1
observe y
"""
CHANGED = np.array([0.0, 1.0, 2.0, 3.5, 6.0])
HELD, LINEAR = np.array([1.6, 0.2, 1.9, 0.5, 1.2]), np.array([0.0, 1.0, 0.5, 0.5, 2.0])


def given(times: np.ndarray) -> np.ndarray:
    """The inputs [T, 2] at times that hold those of the changes."""
    held = HELD[np.searchsorted(CHANGED, times, side="right") - 1]
    return np.stack([held, np.interp(times, CHANGED, LINEAR)], 1)


def test_steps_of_the_module_begin_where_changes_of_inputs_arrive() -> None:
    """At known and learned delays, several in one batch, as those of a fit do."""
    times, delays = np.array(sorted({*CHANGED, *np.arange(0.5, 10, 0.7)})), (0.93, 2.2)
    signals = tuple(Signal(CHANGED, values) for values in (HELD, LINEAR))
    rows = [trajectory(str(c), 0.0, times, np.ones((len(times), 1)), [c], inputs=signals) for c in delays]
    problem, parameters, _ = problem_of(model_of(ARRIVING), Trajectories(tuple(rows), ("y",)), 0.25, blend=0.0)
    engine, theta = torch_engine(problem, parameters), parameters.vector({}, np.array([0.6, 1.37]))
    mean, owner = engine.moments(theta, engine.plan(theta)).mean[:, 0], problem.packed.row_trajectory
    module, start = type(problem.module)(), torch.ones(2, 1, dtype=torch.float64)
    condition, inputs = torch.tensor(delays)[:, None].double(), given(times)
    found = module.simulate(start, times, condition, inputs, max_step=0.25)[..., 0]
    for i, row in enumerate(found):
        np.testing.assert_allclose(row, mean[owner == i], atol=5e-6)
    for one, row, c in zip(start, found, condition, strict=True):
        alone = module.simulate(one, times, c, inputs, max_step=0.25)[..., 0]
        np.testing.assert_allclose(alone, row, atol=1e-14)
    fine = Evaluator(module).integrate([1.0], times, [delays[0]], signals, 0.0)[:, 0]
    assert np.abs(found[0].numpy() - fine).max() < 2e-5


def test_the_derivative_of_the_module_by_a_delay_knows_that_arrivals_move() -> None:
    times, tau = np.array(sorted({*CHANGED, 2.9, 8.3})), torch.tensor(1.37, dtype=torch.float64, requires_grad=True)
    module = load_module(model_of(ARRIVING))()

    def end(delay: object) -> torch.Tensor:
        found = module.simulate([1.0], times, [0.93], given(times), max_step=0.05, constants={"tau": delay})
        return found[-1, 0]

    end(tau).backward()
    change = (end(1.37 + 1e-4) - end(1.37 - 1e-4)) / 2e-4
    assert abs(float(change)) > 0.01
    np.testing.assert_allclose(float(tau.grad), float(change), rtol=1e-4)
