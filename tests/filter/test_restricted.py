"""Sizes of disturbances and noises are those of the restricted likelihood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from gbspec.arrays import Array
from gbspec.data import Trajectories, read
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.runs import Run
from gbspec.training import TrainOptions, filter_run, train
from gbspec.training.engines import FilterEngine
from tests.filter.conftest import engine_of, table

DRIFT = """model drift
time t
state x in [-100, 100] = 0
input u in [-2, 2] held
learn a = 0.1 in [-10, 10]
learn b = 0.1 in [-10, 10]
learn s = 0.3 in [0, 10]
x' = a + b*u
diffusion x = s
observe x noise normal(1e-4)
"""


TWO = """model two
time t
input u in [-2, 2] held
state X in [-5, 5] = 1
state V in [-5, 5] = 1
learn a = 0.5 in [-10, 10]
learn b = 0.4 in [-10, 10]
learn s = 0.3 in [0, 5]
learn r = 0.4 in [0, 5]
X' = a - X + 0.5*V
V' = b*u - 0.3*X
initial V learn
diffusion X = s
diffusion V = r
observe X
observe y = V - 0.2*X
observe V noise normal(0.3)
"""
QUICK = TrainOptions(effort="low", backend="torch", device="cpu")


def fitted(text: str, x: Array, u: Array, folder: Path) -> tuple[Run, Trajectories]:
    """A run and its data of a model of `x`, one row each time unit, with an input `u` that is held."""
    rows = [f"{t},{x[t]:.8f},{u[min(t, len(u) - 1)]:.8f}" for t in range(len(x))]
    (folder / "m.gb").write_text(text, encoding="utf-8")
    (folder / "d.csv").write_text("\n".join(["t,x,u", *rows]) + "\n", encoding="utf-8")
    model = load_model(folder / "m.gb", Findings())
    data = read(folder / "d.csv", model, Findings())
    return train(model, data, QUICK, folder / "run"), data


def test_increments_have_the_variance_of_a_regression(tmp_path: Path) -> None:
    # Exactly measured: increments are independent, with means of two constants, so that the restricted likelihood
    # divides their squares by n - 2, and the likelihood by n.
    rng, n = np.random.default_rng(2), 12
    u = rng.uniform(-2, 2, n)
    x = np.concatenate([[0.0], np.cumsum(1 + 0.5 * u + rng.standard_normal(n))])
    run, _ = fitted(DRIFT, x, u, tmp_path)
    columns = np.stack([np.ones(n), u], axis=1)
    best, squares, *_ = np.linalg.lstsq(columns, np.diff(x), rcond=None)
    found = [run.fit.constants[name].value for name in ("a", "b", "s")]
    np.testing.assert_allclose(found[:2], best, rtol=1e-3)
    np.testing.assert_allclose(found[2], np.sqrt(squares[0] / (n - 2)), rtol=2e-3)


def test_disturbance_and_noise_are_those_of_a_dense_restricted_likelihood(tmp_path: Path) -> None:
    rng, n = np.random.default_rng(5), 40
    u = rng.uniform(-2, 2, n - 1)
    level = np.concatenate([[3.0], 3 + np.cumsum(1 + 0.5 * u + 0.5 * rng.standard_normal(n - 1))])
    x = level + 0.5 * rng.standard_normal(n)
    run, data = fitted(DRIFT.replace(" noise normal(1e-4)", ""), x, u, tmp_path)

    t = np.arange(n)
    columns = np.stack([t, np.concatenate([[0.0], np.cumsum(u)])], axis=1)
    start = np.full((n, n), filter_run(run, data, 0).engine.start_variance[0, 0])

    def restricted(logs: Array) -> float:
        s, r = np.exp(2 * logs)
        whole = start + s * np.minimum(t[:, None], t) + r * np.eye(n)
        inverse = np.linalg.inv(whole)
        normal = columns.T @ inverse @ columns
        rest = (x - x[0]) - columns @ np.linalg.solve(normal, columns.T @ inverse @ (x - x[0]))
        return float(np.linalg.slogdet(whole)[1] + np.linalg.slogdet(normal)[1] + rest @ inverse @ rest)

    best = np.exp(minimize(restricted, np.log([0.5, 0.5]), method="Nelder-Mead", options={"xatol": 1e-6}).x)
    likelihood = run.fit.members[0].likelihood
    assert likelihood is not None
    found = run.fit.constants["s"].value, likelihood.noise["x"].value
    np.testing.assert_allclose(found, best, rtol=5e-3)


@pytest.mark.parametrize("exactly", [True, False], ids=["exact", "sigma"])
def test_the_change_of_the_information_is_that_of_differences(tmp_path: Path, exactly: bool) -> None:
    # a, b and the starts of V enter means alone, so that the change of the information of means is the whole change.
    engine, vector = engine_of(tmp_path, TWO, table("X y V"))
    if not exactly:
        engine = FilterEngine(engine.problem, engine.parameters, engine.start_variance)
        engine.__dict__["exact"] = None
    entries = np.array([2, 3, len(vector) - 2, len(vector) - 1])
    others = np.array([0, 1, *4 + np.flatnonzero(engine.layout.free[4:-2])])
    factor = np.zeros((len(vector), 3))
    factor[others] = np.random.default_rng(3).standard_normal((len(others), 3))
    change = engine.information_change(vector, engine.filtered(vector), factor, entries)

    def size(at: Array) -> float:
        return float(np.trace(factor.T @ engine.information(at).matrix @ factor))

    step = 1e-4 * np.eye(len(vector))[entries]
    differences = [(size(vector + h) - size(vector - h)) / 2e-4 for h in step]
    np.testing.assert_allclose(change, differences, rtol=1e-5)


SEASON = """model season
time t
state d in [-10, 10] = 0
learn m = 5 in [0, 20]
learn c = 1 in [-10, 10]
learn e = 1 in [-10, 10]
learn k = 0.5 in [0.01, 5]
learn s = 1 in [0.01, 20]
d' = -k*d
initial d = 0
diffusion d = s
observe x = m + c*cos(2*pi*t/12) + e*sin(2*pi*t/12) + d noise normal(0.01)
"""


@pytest.mark.parametrize("mean", ["m", "m + q", "m + q*(1 + 1e-7*t)"])
def test_a_rate_that_changes_variances_is_that_of_a_dense_restricted_likelihood(tmp_path: Path, mean: str) -> None:
    # Left out of the restricted likelihood it followed the size of the disturbance to its bound.
    t = np.arange(60.0)
    columns = np.stack([np.ones(60), np.cos(2 * np.pi * t / 12), np.sin(2 * np.pi * t / 12)], axis=1)
    between, beyond = np.abs(np.subtract.outer(t, t)), np.add.outer(t, t)

    def covariance(k: float, s: float) -> Array:
        found: Array = s**2 / (2 * k) * (np.exp(-k * between) - np.exp(-k * beyond)) + 1e-4 * np.eye(60)
        return found

    factor = np.linalg.cholesky(covariance(1.2, 2.8))
    x = columns @ np.array([15.0, 5.0, 2.0]) + factor @ np.random.default_rng(3).standard_normal(60)
    text = SEASON.replace("= m +", f"= {mean} +").replace("learn c", "learn q = 1 in [0, 20]\nlearn c")
    run, _ = fitted(text if "q" in mean else SEASON, x, np.zeros(60), tmp_path)

    def restricted(logs: Array) -> float:
        whole = covariance(*np.exp(logs))
        inverse = np.linalg.inv(whole)
        normal = columns.T @ inverse @ columns
        rest = x - columns @ np.linalg.solve(normal, columns.T @ inverse @ x)
        return float(np.linalg.slogdet(whole)[1] + np.linalg.slogdet(normal)[1] + rest @ inverse @ rest)

    best = np.exp(minimize(restricted, np.log([1.0, 3.0]), method="Nelder-Mead", options={"xatol": 1e-6}).x)
    # The number of k itself is subtracted from that of the values as well, which the dense one does not do.
    np.testing.assert_allclose([run.fit.constants[name].value for name in ("k", "s")], best, rtol=0.04)
