"""Priors of constants: the fit is the mode of the posterior, which for a linear model is known in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data.trajectories import Trajectories
from gbspec.training import TrainOptions, train
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.optimise.priors import Priors, priors_at
from tests.training.conftest import model_of, problem_of, trajectory
from tests.training.reference import linearise, solve, whole_jacobian

pytestmark = pytest.mark.usefixtures("quick_fits")

SD, TIMES = 0.5, np.linspace(0.5, 4, 8)


def straight(prior: str, noise: str = f"noise normal({SD})", more: str = "") -> str:
    return f"""model straight
time t from 0
state x
learn k = 1 {prior}
x' = k
initial x = 0
observe x {noise}
{more}"""


def data(slopes: list[float], sd: float = SD, channels: int = 1) -> Trajectories:
    rng = np.random.default_rng(1)
    items = [
        trajectory(str(i), 0.0, TIMES, k * TIMES[:, None] + sd * rng.standard_normal((8, channels)), [])
        for i, k in enumerate(slopes)
    ]
    return Trajectories(tuple(items), ("x",), "made.csv", "0" * 64)


def posterior(table: Trajectories, mean: float, sd: float, noise: float = SD) -> tuple[float, float]:
    """Mean and standard deviation of the slope: precision-weighted, all trajectories alike."""
    precision = len(table) * float(TIMES @ TIMES) / noise**2
    least = sum(float(TIMES @ item.values[:, 0]) for item in table.items) / (len(table) * float(TIMES @ TIMES))
    total = precision + 1 / sd**2
    return (precision * least + mean / sd**2) / total, total**-0.5


@pytest.mark.parametrize("method", ["auto", "lm", "lbfgs"])
def test_a_normal_prior_gives_the_posterior_of_a_linear_model(method: str, tmp_path: Path) -> None:
    table = data([2.0])
    options = TrainOptions(
        method=method, max_step=0.5, epochs=60 if method != "auto" else None, forcing="autoregressive"
    )  # type: ignore[arg-type]
    run = train(model_of(straight("prior normal(1, 0.05)")), table, options, tmp_path / "run")
    mean, _ = posterior(table, 1.0, 0.05)
    assert mean < 1.9, "the prior matters"
    # Huber's function, which `lm` minimises, is not quite that of the normal distribution.
    assert run.fit.constants["k"].value == pytest.approx(mean, rel=0.1 if method == "lm" else 1e-4)


def test_adam_reaches_the_posterior_too(tmp_path: Path) -> None:
    table = data([2.0, 2.1])
    options = TrainOptions(
        method="adam", epochs=60, max_step=0.5, learning_rate=0.03, forcing="autoregressive", batch_size=1
    )
    run = train(model_of(straight("prior normal(1, 0.05)")), table, options, tmp_path / "run")
    assert run.fit.constants["k"].value == pytest.approx(posterior(table, 1.0, 0.05)[0], rel=5e-3)


def test_a_lognormal_prior_acts_on_the_logarithm(tmp_path: Path) -> None:
    table, cv = data([2.0]), 0.03
    run = train(
        model_of(straight(f"prior lognormal(1, {cv})")),
        table,
        TrainOptions(effort="low", max_step=0.5),
        tmp_path / "run",
    )
    k = run.fit.constants["k"].value
    slope = float(TIMES @ (k * TIMES - table.items[0].values[:, 0])) / SD**2
    assert slope + np.log(k) / np.log1p(cv**2) / k == pytest.approx(0, abs=1e-2 * abs(slope)), "the mode of log k"
    assert 1.0 < k < 1.9


def test_without_a_stated_noise_the_residuals_tell_it(tmp_path: Path) -> None:
    table = data([2.0] * 30)
    run = train(
        model_of(straight("prior normal(1, 0.1)", noise="")),
        table,
        TrainOptions(effort="low", max_step=0.5),
        tmp_path / "run",
    )
    mean, _ = posterior(table, 1.0, 0.1)
    assert mean < 1.98
    assert run.fit.constants["k"].value == pytest.approx(mean, abs=0.01)


def test_each_trajectory_has_the_prior_for_itself(tmp_path: Path) -> None:
    table = data([1.0, 3.0])
    model = model_of(straight("prior normal(2, 0.05) per trajectory"))
    own = (
        train(model, table, TrainOptions(effort="low", max_step=0.5), tmp_path / "run")
        .member()
        .weights["per_trajectory.k"]
    )
    for i, item in enumerate(table.items):
        expected, _ = posterior(Trajectories((item,), ("x",)), 2.0, 0.05)
        assert own[i] == pytest.approx(expected, rel=1e-3)


def test_what_the_data_do_not_tell_stays_at_the_prior(tmp_path: Path) -> None:
    text = straight("> 0", more="learn a = 5 > 0 prior lognormal(2, 0.1)\n").replace("x' = k", "x' = k*a")
    run = train(model_of(text), data([2.0]), TrainOptions(effort="low", max_step=0.5), tmp_path / "run")
    constants = run.fit.constants
    assert constants["a"].value == pytest.approx(2, rel=1e-2)
    assert constants["a"].sd == pytest.approx(0.2, rel=0.3)


SUBSTRATE = """
model culture
state X in [0, 20]
state S in [0, 30] = 10
learn Y = 0.5 in [0.1, 1]
unknown mu(S) >= 0 by mlp(8)
X' = mu*X
S' = -mu*X/Y
initial S learn
observe X
"""


def test_initial_values_of_unmeasured_states_have_a_prior_from_the_range() -> None:
    problem, parameters, theta = problem_of(model_of(SUBSTRATE), data([1.0, 2.0]), 0.5, blend=0.0)
    priors = Priors.of(problem, parameters, solve(problem, parameters, theta))
    assert len(priors) == 2
    assert priors.rows(parameters.with_starts(theta, np.full((2, 2), 10.0))) == pytest.approx([0.0, 0.0], abs=1e-12)
    moved = parameters.with_starts(theta, np.array([[1.0, 25.0], [1.0, 2.5]]))
    assert priors.rows(moved) == pytest.approx([priors.spread, -0.5 * priors.spread])
    step = np.random.default_rng(0).standard_normal(len(theta))
    change = (priors.penalty(moved + 1e-6 * step) - priors.penalty(moved - 1e-6 * step)) / 2e-6
    assert priors.gradient(moved) @ step == pytest.approx(change, rel=1e-6)
    for text in (SUBSTRATE.replace("in [0, 30] ", ""), SUBSTRATE.replace("learn\n", "= 10\n")):
        problem, parameters, theta = problem_of(model_of(text), data([1.0, 2.0]), 0.5, blend=0.0)
        assert len(priors_at(TorchEngine(problem, parameters), theta)) == 0


def test_rows_and_gradients_agree_with_differences() -> None:
    text = straight("in [0, 5] prior lognormal(1.5, 0.2)", more="learn b = 1 prior normal(2, 0.3) per trajectory\n")
    model = model_of(text.replace("x' = k", "x' = k + b*t"))
    problem, parameters, theta = problem_of(model, data([1.0, 2.0]), 0.5, blend=0.0)
    priors = Priors.of(problem, parameters, solve(problem, parameters, theta))
    assert len(priors) == 3 and priors.noise == problem.scaling.noise
    system = priors.with_rows(linearise(problem, parameters, theta), theta)
    dense = whole_jacobian(system, parameters).numpy()
    direction, h = np.random.default_rng(0).standard_normal(len(theta)), 1e-6
    ahead, behind = (
        np.concatenate([solve(problem, parameters, at), priors.rows(at)])
        for at in (theta + h * direction, theta - h * direction)
    )
    assert np.allclose((ahead - behind) / (2 * h), dense @ direction, rtol=1e-6, atol=1e-8)
    change = (priors.penalty(theta + h * direction) - priors.penalty(theta - h * direction)) / (2 * h)
    assert priors.gradient(theta) @ direction == pytest.approx(change, rel=1e-6)
    assert len(priors_at(TorchEngine(problem, parameters), theta)) == 3
