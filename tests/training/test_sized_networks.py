"""Unknown functions that act on unmeasured states alone: their size is sought among whole solutions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.diagnostics import Findings
from gbspec.passes import with_contracts
from gbspec.training import TrainOptions, train
from gbspec.training.recipe import build_context, prepare
from gbspec.training.starts import eliminate, unseen_outputs
from tests.training.conftest import model_of, trajectory

EPIDEMIC = """
model epidemic
time t : day from 0
condition s0 in [0, 1]
const gam = 0.2
state S in [0, 1]
state I in [0, 0.2]
learn rho = 0.6 in [0.05, 1]
unknown b(I in [0, 0.05]) >= 0, decreasing in I by mlp(8, 8)
S' = -b*S*I
I' = b*S*I - gam*I
initial S = s0
initial I = 0.001
observe cases = 1000*rho*b*S*I
"""
TRUE_RHO = 0.35


def transmission(prevalence: Array) -> Array:
    """The true rate, by the share of people who are ill."""
    return np.asarray(0.55 / (1 + (prevalence / 0.02) ** 1.5) + 0.12)


def epidemics() -> Trajectories:
    """Reports of four epidemics with noise of 2 % of their largest number."""
    rng, items, t = np.random.default_rng(5), [], np.linspace(2.0, 90.0, 30)
    for i, s0 in enumerate([0.94, 0.8, 0.7, 0.88]):

        def rates(_: float, x: Array) -> list[float]:
            new = float(transmission(max(x[1], 0.0))) * x[0] * x[1]
            return [-new, new - 0.2 * x[1]]

        s, ill = solve_ivp(rates, (0, 90), [s0, 0.001], t_eval=t, rtol=1e-9, atol=1e-12).y
        cases = 1000 * TRUE_RHO * transmission(ill) * s * ill
        values = cases + 0.02 * cases.max() * rng.normal(size=len(t))
        items.append(trajectory(str(i), 0.0, t, values[:, None], [s0]))
    return Trajectories(tuple(items), ("cases",))


def test_a_flow_between_unmeasured_states_is_learned_from_a_part_of_it(tmp_path: Path) -> None:
    """By ranges its size was guessed a twelfth of what it is: no epidemic began, and no stage moved anything."""
    run = train(model_of(EPIDEMIC), epidemics(), TrainOptions(backend="native", workers=1), tmp_path / "run")
    found = run.fit.constants["rho"]
    assert found.sd is not None
    assert abs(found.value - TRUE_RHO) < 3 * found.sd < 0.15
    prevalence = np.array([[0.002], [0.01], [0.02]])
    learned = run.member().functions["b"](torch.from_numpy(prevalence)).detach().numpy()
    np.testing.assert_allclose(learned, transmission(prevalence[:, 0]), rtol=0.1)


def test_an_argument_that_is_not_measured_is_scaled_by_its_own_range() -> None:
    model = model_of(EPIDEMIC)
    parameters = prepare(model, load_module(model), epidemics(), TrainOptions(), 0).parameters
    assert parameters.fixed["network.b.input_center"] == pytest.approx(0.025)
    assert 0.1 < float(parameters.fixed["network.b.output_center"][0]) < 3


@pytest.mark.parametrize(("balance", "unseen"), [("f(y) - x", False), ("k*y - x", True)])
def test_what_slopes_show_needs_no_draws(balance: str, unseen: bool) -> None:
    """A function in the balance of a measured state has the size of its slopes, whatever its argument is."""
    other = "f(y) - y" if unseen else "-y"
    states = "model m\nstate x in [0, 2]\nstate y in [0, 2]\nlearn k = 1\nunknown f(y)\n"
    text = f"{states}x' = {balance}\ny' = {other}\nobserve x\n"
    model = model_of(text)
    t = np.linspace(0, 5, 30)
    data = Trajectories((trajectory("1", 0.0, t, np.exp(-t)[:, None], []),), ("x",))
    context = build_context(model, load_module(model), data, TrainOptions(), 0)
    found = eliminate(model, context.module, context.points, np.zeros(1))
    assert unseen_outputs(model, found)["f"].tolist() == [unseen]


def test_coefficients_gates_and_postulates_have_no_drawn_size() -> None:
    """What contracts and splines add to a network is no guess by ranges, nor is the neutral value of a postulate."""
    text = """model m
state x in [0, 2]
state y in [0, 2]
learn k = 1
unknown f(y in [0, 2]) by spline(6)
unknown g(y) zero at y = 0, increasing in y by mlp(4)
unknown h(y) = 2*nn by mlp(4)
x' = k*y - x
y' = f(y) - g(y) - h(y)*y
observe x
"""
    model = with_contracts(model_of(text), Findings())
    t = np.linspace(0, 5, 30)
    data = Trajectories((trajectory("1", 0.0, t, np.exp(-t)[:, None], []),), ("x",))
    context = build_context(model, load_module(model), data, TrainOptions(), 0)
    found = unseen_outputs(model, eliminate(model, context.module, context.points, np.zeros(1)))
    assert not found["f"].any() and not found["h"].any()
    assert not found["g"][1:].any()
