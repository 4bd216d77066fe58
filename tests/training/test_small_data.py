"""Few noisy rows: what is learned between the points is as smooth as the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from gbspec.data.trajectories import Trajectories
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

BATCH = """model batch
state X in [0, 8] = 1
state S in [0, 10] = 5
unknown mu(S) by mlp(8, 8)
X' = mu(S)*X
S' = -2*mu(S)*X
observe X
observe S
"""


def monod(s: np.ndarray) -> np.ndarray:
    return 0.6 * s / (1.0 + s)


def batches() -> tuple[Trajectories, np.ndarray]:
    """Forty rows in four batches, 4 % noise; and the true states at the first rows."""
    rng = np.random.default_rng(5)
    items, starts = [], []
    for i, (x, s) in enumerate(((0.3, 9.0), (0.8, 6.0), (0.5, 4.0), (1.2, 8.0))):
        times = np.sort(rng.uniform(0, 5, 10))
        found = solve_ivp(
            lambda t, y: np.array([1.0, -2.0]) * monod(y[1]) * y[0], (0, 5), [x, s], t_eval=times, rtol=1e-8
        )
        noisy = found.y.T + 0.04 * rng.standard_normal((10, 2)) * found.y.std(axis=1)
        items.append(trajectory(str(i), float(times[0]), times, noisy, []))
        starts.append(found.y[:, 0])
    return Trajectories(tuple(items), ("X", "S"), "made.csv", "0" * 64), np.array(starts)


def test_forty_noisy_rows_do_not_wiggle(tmp_path: Path) -> None:
    data, starts = batches()
    run = train(model_of(BATCH), data, TrainOptions(effort="low", max_step=0.3), tmp_path / "run")
    s = np.linspace(0.3, 8.5, 200)
    with torch.no_grad():
        found = run.member().functions["mu"](torch.from_numpy(s)[:, None]).numpy().ravel()
    truth = monod(s)
    assert np.sqrt(np.mean((found - truth) ** 2)) < 0.05 * np.ptp(truth) + 0.02
    assert np.abs(np.diff(found)).sum() < 1.2 * np.abs(np.diff(truth)).sum(), "total variation"
    assert np.abs(np.diff(found, 2)).sum() < 2.5 * np.abs(np.diff(truth, 2)).sum(), "variation of the slope"
    measured = np.array([item.values[0] for item in data.items])
    moved = run.member().weights["initial"]
    assert not np.allclose(moved, measured), "measured first values count as measurements, noise and all"
    assert np.abs(moved - starts).mean() < np.abs(measured - starts).mean()
