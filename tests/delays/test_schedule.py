"""Right sides, delayed quantities and histories that jump by themselves: steps end there, and where it shows again."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.data.trajectories import Trajectories
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.engines.objective import linearise, predicted
from tests.backends.same_kernel import compare
from tests.training.conftest import model_of, problem_of, trajectory

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

TEXT = """model late
time t from 0
state x in [0, 9] = 1
learn k = 0.4 in [0, 2]
learn tau = 0.7 in [0.3, 1]
let light = if(mod(t, 6) < 2, 1, 0)
initial x = 1
observe x
x' = -k*x + {}
"""
CASES = {
    "right side": "light - 0.2*delay(x, tau)",
    "what is delayed": "delay(light, tau)",
    "both": "0.3*floor(t/2) + delay(light, tau) - 0.2*delay(x, tau)",
    "before the start": "delay(light, tau) - 0.1*delay(x, tau)\nhistory x = 1 + if(t > -0.4, 0, 0.5)",
}
TIMES = np.arange(0.0, 9.5, 1.0)
KNOWN = [0.4, 0.7]


def data_of(values: np.ndarray) -> Trajectories:
    return Trajectories((trajectory("a", 0.0, TIMES, values[:, None], []),), ("x",))


@pytest.mark.parametrize("case", CASES)
def test_equal_steps_keep_the_order_of_the_method(case: str) -> None:
    model = model_of(TEXT.format(CASES[case]))
    evaluator = Evaluator(load_module(model)())
    known = evaluator.integrate([1.0], TIMES, constants=KNOWN)[:, 0]
    steps = (0.2, 0.1)
    errors = [
        np.abs(evaluator.integrate_fixed([1.0], TIMES, max_step=step, constants=KNOWN)[:, 0] - known).max()
        for step in steps
    ]
    assert errors[0] < 1e-6 and errors[1] < errors[0] / 8
    for step, error in zip(steps, errors, strict=True):
        problem, parameters, _ = problem_of(model, data_of(known), step, blend=0.0)
        theta = parameters.vector({}, np.array(KNOWN))
        for engine in (torch_engine, native_engine):
            found = predicted(engine(problem, parameters), theta).mean.ravel()
            assert np.abs(found - known).max() < 2 * error + 1e-12


def test_delayed_light_in_closed_form() -> None:
    """x' = light(t - tau) - k x has a solution by pieces."""
    evaluator = Evaluator(load_module(model_of(TEXT.format(CASES["what is delayed"])))())
    found = evaluator.integrate([1.0], TIMES, constants=KNOWN)[:, 0]
    cuts, wanted, x, before = [0.7, 2.7, 6.7, 8.7, 12.7], {}, 1.0, 0.0
    for time in sorted({*TIMES, *cuts}):
        level = 2.5 if (0.5 * (time + before) - 0.7) % 6 < 2 else 0.0
        x, before = level + (x - level) * np.exp(-0.4 * (time - before)), time
        wanted[time] = x
    np.testing.assert_allclose(found, [wanted[time] for time in TIMES], rtol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_the_derivative_by_a_learned_delay(case: str) -> None:
    """Jumps that show later move with the delay: a formula that jumps has no slope itself."""
    model = model_of(TEXT.format(CASES[case]))
    evaluator = Evaluator(load_module(model)())
    tau, size = 0.713, 1e-4
    ahead, behind = (
        evaluator.integrate([1.0], TIMES, constants=[0.4, tau + sign * size])[:, 0] for sign in (1.0, -1.0)
    )
    problem, parameters, _ = problem_of(model, data_of(np.ones(len(TIMES))), 0.05, blend=0.0)
    theta = parameters.vector({}, np.array([0.4, tau]))
    wanted = (ahead - behind) / np.abs(ahead - behind).max()
    for engine in (torch_engine, native_engine):
        found = linearise(engine(problem, parameters), theta).shared[:, 1].numpy()
        np.testing.assert_allclose(found / np.abs(found).max(), wanted[-len(found) :], atol=1e-5)


@pytest.mark.parametrize("blend", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("case", CASES)
def test_the_kernel_has_the_same(case: str, blend: float) -> None:
    values = 1 + 0.3 * np.sin(TIMES)
    problem, parameters, theta = problem_of(model_of(TEXT.format(CASES[case])), data_of(values), 0.23, blend=blend)
    compare(problem, parameters, theta, ("float64",))
