"""States between two numbers whose disturbances are proportional to the distances from both: their logits are
filtered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis import simulate
from gbspec.data import SimulateOptions
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.operations import models
from gbspec.training.engines.filter.functions import Functions
from tests.filter.conftest import engine_of, table

SHARE = """model share
time t
input u in [-2, 2] linear
state X in [-5, 5] = 1
state V in [-1, 3] = 1
learn theta = 1 in [0.01, 10]
learn s = 0.3 in [0, 5]
learn r = 0.4 in [0, 5]
X' = -theta*X + 0.5*V
V' = theta*(1 + V)*(3 - V)*(0.2*u - 0.1*X)
diffusion X = s
diffusion V = r*(1 + V)*(3 - V)
initial V = 0.5
observe X noise normal(0.1)
observe y = X + V
"""
BY_HAND = (
    SHARE.replace("state V in [-1, 3] = 1", "state L in [-9, 9] = 0\nlet V = -1 + 4/(1 + exp(-L))")
    .replace("V' = theta*(1 + V)*(3 - V)*(0.2*u - 0.1*X)", "L' = 4*theta*(0.2*u - 0.1*X) + (4*r)^2*(V - 1)/4")
    .replace("diffusion V = r*(1 + V)*(3 - V)", "diffusion L = 4*r")
    .replace("initial V = 0.5", "initial L = log(1.5/2.5)")
)
WITH_NETWORK = SHARE.replace("0.2*u - 0.1*X", "0.2*u - q").replace(
    "learn theta", "unknown q(X, V) by mlp(3)\nlearn theta"
)


def test_the_likelihood_is_that_of_the_equation_for_the_logit(tmp_path: Path) -> None:
    data, found = table("X y", rows=12), []
    for number, text in enumerate((SHARE, BY_HAND)):
        (tmp_path / str(number)).mkdir()
        engine, vector = engine_of(tmp_path / str(number), text, data)
        found.append(engine.information(vector))
    # Points of what is known exactly are apart by a share of the typical size, which the logit's range sets by hand.
    assert found[0].value == pytest.approx(found[1].value, rel=1e-6)
    np.testing.assert_allclose(found[0].gradient, found[1].gradient, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("text", [SHARE, SHARE.replace("initial V = 0.5", "initial V learn"), WITH_NETWORK])
def test_the_gradient_agrees_with_differences(tmp_path: Path, text: str) -> None:
    engine, vector = engine_of(tmp_path, text, table("X y", rows=12))
    gradient, rng, h = engine.information(vector).gradient, np.random.default_rng(1), 1e-5
    for _ in range(2):
        direction = rng.standard_normal(len(vector)) * engine.layout.free
        change = (engine.value(vector + h * direction) - engine.value(vector - h * direction)) / (2 * h)
        assert gradient @ direction == pytest.approx(change, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("text", [SHARE, WITH_NETWORK])
def test_numpy_has_the_numbers_of_torch(tmp_path: Path, text: str) -> None:
    fast, vector = engine_of(tmp_path, text, table("X y", rows=9))
    plain = replace(fast)
    plain.__dict__["functions"] = Functions(fast.functions.local, None)
    one, other = fast.information(vector), plain.information(vector)
    assert one.value == pytest.approx(other.value, rel=1e-10)
    np.testing.assert_allclose(one.gradient, other.gradient, rtol=1e-7, atol=1e-9)


def test_a_spread_start_stays_between_the_numbers(tmp_path: Path) -> None:
    """The moments of a share whose start nothing tells; by a normal distribution of the share itself the logistic
    balance grows without bound outside."""
    text = (
        "model m\ntime t\nstate x in [0, 5] = 1\nstate p in [0, 1] = 0.7\nlearn k = 4 in [3, 5]\n"
        "learn s = 0.2 in [0, 2]\nx' = p - x\np' = k*p*(p - 1)*(0.5 - p)\ndiffusion x = s\n"
        "diffusion p = s*p*(1 - p)\nobserve x\n"
    )
    rows = "\n".join(f"0,{t},{0.6 + 0.1 * (-1) ** t}" for t in range(30, 40))
    engine, vector = engine_of(tmp_path, text, f"trajectory,t,x\n0,0,\n{rows}\n")
    found = engine.filtered(vector)
    assert found.finite
    states = engine.coordinates.states(found.end_mean)
    assert (states[:, 1] > 0).all()
    assert (states[:, 1] < 1).all()


@pytest.mark.parametrize(
    ("size", "between"),
    [
        ("s*V*(1 - V)", (0.0, 1.0)),
        ("s*V*(4 - V)/c", (0.0, 4.0)),
        ("c*(V^2 - 1)", (-1.0, 1.0)),
        ("s*V*(1 - V/K)", (0.0, 5.0)),
        ("s*V", None),
        ("s*(1 + V^2)", None),
        ("s*(V - c)*(4 - V)", None),
        ("s*(V - 1)^2", None),
    ],
)
def test_two_numbers_are_found(size: str, between: tuple[float, float] | None) -> None:
    text = (
        f"model m\nstate V in [0, 1] = 0.5\nlearn s = 1 in [0, 2]\nlearn c = 1 in [0.5, 2]\nconst K = 5\nV' = c - V/K\n"
        f"diffusion V = {size}\nobserve V\n"
    )
    model = load_model("m", Findings(), lambda _: Source("m.gb", text))
    assert model.diffusions[0].between == (None if between is None else pytest.approx(between))


def test_simulated_shares_stay_between_and_keep_their_mean(tmp_path: Path) -> None:
    text = (
        "model m\nstate p in [0, 1] = 0.3\nlearn s = 1 in [0, 2]\np' = 0*s\ninitial p = 0.3\n"
        "diffusion p = s*p*(1 - p)\nobserve p\ntruth\n    s = 1.5\n"
    )
    (tmp_path / "m.gb").write_text(text, encoding="utf-8")
    subject = models.reference(load_model(tmp_path / "m.gb", Findings()))
    options = SimulateOptions(trajectories=30, span=1.0, dt=0.5, noise=0.0, seed=1)
    ends = np.array([item.values[-1, 0] for item in simulate(subject.evaluator, subject.model, options).items])
    assert ends.min() > 0
    assert ends.max() < 1
    # Without a drift the mean of an Ito equation stays.
    assert abs(ends.mean() - 0.3) < 4 * ends.std() / np.sqrt(len(ends))
    assert ends.std() > 0.2
