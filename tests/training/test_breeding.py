"""Bred initial states lie on the slow manifold; models that say how a state starts are left alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gbspec.data.trajectories import Trajectories
from gbspec.runs.store import Run
from gbspec.training import TrainOptions, train
from gbspec.training.recipe import breeding
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

FAST = """model fast
state a in [0, 4] = 1
state h in [0, 4] = 1
learn k = 0.3 in [0, 2]
a' = -k*h
h' = 8*(a - h)
observe a
"""


QUICK = {"method": "lm", "epochs": 5, "forcing": "autoregressive", "max_step": 0.25}


def decays(count: int = 4) -> tuple[Trajectories, np.ndarray]:
    """Noisy measurements of `a` (k = 0.5) at 1, 1.5, ..., and the true states at the first of them."""
    rng = np.random.default_rng(3)
    items, starts = [], []
    for i in range(count):
        times = np.arange(1.0, 6.0, 0.5)
        found = solve_ivp(
            lambda t, x: [-0.5 * x[1], 8 * (x[0] - x[1])], (0, 6), rng.uniform(1, 3, 2), t_eval=times, rtol=1e-8
        )
        starts.append(found.y[:, 0])
        noisy = found.y[0] + 0.02 * rng.standard_normal(len(times))
        items.append(trajectory(str(i), 1.0, times, noisy[:, None], []))
    return Trajectories(tuple(items), ("a",), "made.csv", "0" * 64), np.array(starts)


def off(run: Run, true: np.ndarray) -> float:
    return float(np.median(np.abs(run.member().weights["initial"][:, 1] - true[:, 1])))


def test_bred_starts_lie_on_the_slow_manifold(tmp_path: Path) -> None:
    data, true = decays()
    errors = {}
    for initial in ("learned", "bred"):
        run = train(model_of(FAST), data, TrainOptions(initial=initial, **QUICK), tmp_path / initial)  # type: ignore[arg-type]
        errors[initial] = off(run, true)
        assert run.fit.constants["k"].value == pytest.approx(0.5, rel=0.05)
    assert errors["bred"] < 0.05
    assert errors["bred"] < 0.3 * errors["learned"]


def test_an_expressed_start_is_not_bred(tmp_path: Path) -> None:
    data, _ = decays(2)
    model = model_of(FAST + "state c in [0, 9]\nc' = k*h\ninitial c = 0\n")
    run = train(model, data, TrainOptions(initial="bred", **QUICK), tmp_path / "run")  # type: ignore[arg-type]
    assert any("not bred" in warning and "`c`" in warning for warning in run.fit.warnings)


@pytest.mark.parametrize(("start", "times"), [(1.0, [1.0, 2.0, 4.0]), (0.0, [0.0, 1.0, 2.0, 4.0])])
def test_an_earlier_start_leaves_a_row_where_the_trajectory_began(start: float, times: list[float]) -> None:
    item = trajectory("a", start, np.array([1.0, 2.0, 4.0]), np.array([[5.0], [6.0], [7.0]]), [])
    earlier = breeding._begun_earlier(item)
    assert earlier.start < start and earlier.times.tolist() == times
    new = len(times) - 3
    assert np.isnan(earlier.values[:new]).all() and earlier.values[new:, 0].tolist() == [5.0, 6.0, 7.0]
    assert earlier.counts[:, 0].tolist() == [0.0] * new + [1.0] * 3 and earlier.sd.shape == earlier.values.shape
