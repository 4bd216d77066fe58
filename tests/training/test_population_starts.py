"""Where the fits of populations with networks begin: effects of single trajectories break the symmetry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gbspec.diagnostics import Findings
from gbspec.operations import tables
from gbspec.runs import ErrorsRecord
from gbspec.training import TrainOptions, train
from gbspec.training.engines import choice
from gbspec.training.population.pooled import pooled_model
from gbspec.training.runs.populations import said_of_errors
from tests.training.test_populations import NETWORK, model_of, table

KNOWN = """model known
time t from 0
state x
effect e per trajectory
learn k = 0.5 in [0.01, 5]
learn s = 0.4 in [0, 3]
x' = -k*exp(s*e)*x
initial x = 2
observe x
"""


def test_effects_are_estimated_for_each_trajectory_only_where_they_are_arguments_of_networks(tmp_path: Path) -> None:
    with_network, known = (pooled_model(model_of(text, tmp_path)) for text in (NETWORK, KNOWN))
    assert [k.per_trajectory for k in with_network.learnables if k.name == "e"] == [True]
    assert [k.per_trajectory for k in known.learnables if k.name == "e"] == [False]


def test_the_kernel_is_worth_its_compilation_for_a_population(tmp_path: Path) -> None:
    """Inner problems solve the model hundreds of times in each iteration."""
    model = model_of(NETWORK, tmp_path)
    assert model.distributed and not choice.few(model, TrainOptions(), 10)


@pytest.mark.parametrize(("noise", "few"), [("normal(0.1)", True), ("normal(s)", False), ("poisson", False)])
def test_the_kernel_is_worth_its_compilation_for_a_likelihood(noise: str, few: bool, tmp_path: Path) -> None:
    """It was not even measured, since none of the stages counted, and the torch graph took twenty times as long."""
    text = f"time t from 0\nstate x = 2\nlearn s = 0.4 in [0, 3]\nunknown f(x)\nx' = -f(x)\nobserve x noise {noise}\n"
    model = model_of(f"model alone\n{text}", tmp_path)
    assert not model.distributed and choice.few(model, TrainOptions(), 10) is few


def test_effects_beside_a_network_are_pooled(tmp_path: Path) -> None:
    """Free ones would let their factor run to its bound before the marginal likelihood begins."""
    text = KNOWN.replace("-k*exp(s*e)*x", "-exp(s*e)*f(x)").replace("learn k = 0.5 in [0.01, 5]", "unknown f(x)")
    pooled = pooled_model(model_of(text, tmp_path))
    assert [k.per_trajectory for k in pooled.learnables if k.name == "e"] == [False]


@pytest.mark.usefixtures("quick_fit")
def test_a_network_learns_to_depend_on_its_effect(tmp_path: Path) -> None:
    """Rates differ by a factor of 4 between trajectories, which only the network's effect can explain."""
    random, times = np.random.default_rng(7), np.array([0.3, 0.8, 1.5, 2.5, 4.0])
    rate = 0.5 * np.exp(0.7 * np.linspace(-1, 1, 8))[:, None]
    values = 2 * np.exp(-rate * times) + 0.02 * random.standard_normal((8, 5))
    model = model_of(NETWORK, tmp_path)
    data = tables.read_data(table(tmp_path, values, times), model, Findings())
    run = train(model, data, TrainOptions(max_step=0.5, effort="low"), tmp_path / "run")
    assert run.fit.noise["x"] is not None
    assert run.fit.noise["x"] < 0.06  # without the dependence it is 0.2
    own = run.fit.constants["e"].per_trajectory
    assert own is not None
    found = np.array([own[str(i + 1)].value for i in range(8)])
    assert abs(np.corrcoef(found, np.arange(8))[0, 1]) > 0.95


GROWING = """model growing
time t from 0
condition diet in {"1", "2"}
state w in [100, 800]
learn w0 = 300 in [100, 700] per trajectory ~ lognormal
learn K = 600 in [200, 2000] per diet
learn r = 0.01 in [0.0001, 0.5]
w' = r*w*(1 - w/K)
initial w = w0
observe w
"""


@pytest.mark.usefixtures("quick_fit")
def test_a_pooled_search_that_ends_at_a_bound_is_not_the_only_start(tmp_path: Path) -> None:
    """Animals of two diets differ in weight from the start: all with the same one, they look as if grown at once."""
    random, times, found = np.random.default_rng(4), np.arange(1.0, 65.0, 9.0), []
    start = np.concatenate([np.linspace(220, 280, 6), np.linspace(420, 500, 6)])[:, None]
    values = 700 / (1 + (700 / start - 1) * np.exp(-0.004 * times)) + 3 * random.standard_normal((12, len(times)))
    lines = ["trajectory,t,w,diet"]
    lines += [f"{k + 1},{t},{values[k, i]:.3f},{1 + k // 6}" for k in range(12) for i, t in enumerate(times)]
    for name, text in (("wide", GROWING), ("narrow", GROWING.replace("0.5]", "0.03]"))):
        folder = tmp_path / name
        folder.mkdir()
        model = model_of(text, folder)
        (folder / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        run = train(model, tables.read_data(folder / "d.csv", model, Findings()), TrainOptions(), folder / "run")
        assert run.fit.population is not None
        found.append(run.fit.population.minus2ll)
    assert abs(found[0] - found[1]) < 0.1


ORAL = """model oral
time t : h from 0
state A in [0, 400]
state c in [0, 20]
learn ka = 1 in [0.1, 10]
learn V = 40 in [5, 200] per trajectory ~ lognormal
unknown q(c) >= 0 by mlp(8) zero at c = 0
A' = -ka*A
c' = (ka*A - q(c))/V
dose A
initial A = 0
initial c = 0
observe c
"""


@pytest.mark.usefixtures("quick_fit")
@pytest.mark.parametrize("seed", [0, 1])
def test_a_pooled_fit_that_exchanges_two_rates_is_not_the_only_start(tmp_path: Path, seed: int) -> None:
    """With the same constants for all subjects, slow absorption into a small volume fits as well as what is true."""
    random, times = np.random.default_rng(2), np.array([0.5, 1, 2, 4, 8, 16, 24])
    lines = ["trajectory,t,c,dose_A"]
    for j in range(10):
        volume, dose = 35 * np.exp(0.3 * random.normal()), (100.0, 200.0, 400.0)[j % 3]

        def rates(t: float, x: np.ndarray, volume: float = volume) -> list[float]:
            return [-1.2 * x[0], (1.2 * x[0] - 15 * x[1] / (1.5 + x[1])) / volume]

        found = solve_ivp(rates, (0, 24.1), [dose, 0.0], t_eval=times, rtol=1e-8, atol=1e-8).y[1]
        lines.append(f"{j},0,,{dose}")
        values = found * (1 + 0.05 * random.normal(size=7)) + 0.02 * random.normal(size=7)
        lines += [f"{j},{t},{value:.4f}," for t, value in zip(times, values, strict=True)]
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    model = model_of(ORAL, tmp_path)
    data = tables.read_data(tmp_path / "d.csv", model, Findings())
    fit = train(model, data, TrainOptions(effort="low", max_step=0.5, seed=seed), tmp_path / "run").fit
    assert fit.constants["ka"].value == pytest.approx(1.2, rel=0.2)
    assert fit.constants["V"].value == pytest.approx(35, rel=0.3)


def test_values_that_are_not_distributed_as_the_model_says_are_told(tmp_path: Path) -> None:
    errors = {"good": ErrorsRecord(100, 0.1, 1.1, 0.2), "bad": ErrorsRecord(100, 0.1, 0.6, 1e-5)}
    (said,) = said_of_errors(errors, model_of(ORAL, tmp_path))
    assert "`bad`" in said
    assert "variance 0.6" in said
