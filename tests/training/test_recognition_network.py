"""A recognition network gives hidden starts of new trajectories from their first measurements."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gbspec.analysis.prediction.estimate import Estimator
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.data.scales import scales_of
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.data.window import recognised
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

CHAIN = """model chain
state A in [0, 4] = 1
state B in [0, 4] = 1
learn k = 0.3 in [0, 2]
A' = -k*A
B' = k*A - 0.4*B
observe B
"""


def decays(count: int, seed: int) -> tuple[Trajectories, np.ndarray]:
    """Exact solutions (k = 0.8), B measured every 0.4; and the hidden A at the start of each."""
    rng = np.random.default_rng(seed)
    times, items, hidden = np.arange(0, 4.0, 0.4), [], []
    for i in range(count):
        a, b = rng.uniform(0.5, 3, 2)
        part = 0.8 * a / (0.4 - 0.8)
        values = part * np.exp(-0.8 * times) + (b - part) * np.exp(-0.4 * times)
        items.append(trajectory(str(i), 0.0, times, values[:, None], []))
        hidden.append(a)
    return Trajectories(tuple(items), ("B",), "made.csv", "0" * 64), np.array(hidden)


def test_hidden_starts_are_recognised(tmp_path: Path) -> None:
    data, _ = decays(12, 1)
    model = model_of(CHAIN)
    options = TrainOptions(initial="recognition", method="lm", epochs=6, forcing="autoregressive", max_step=0.2)
    run = train(model, data, options, tmp_path / "run")
    new, true = decays(5, 2)
    found = [recognised(run.member().weights, model, item) for item in new.items]
    guessed, error = (np.array([one[part][0] for one in found if one is not None]) for part in (0, 1))
    assert len(guessed) == 5
    assert np.abs(guessed - true).max() < 0.25, "the mean of the starts would be off by about 0.6"
    assert (np.abs(guessed - true) < 6 * error).all()

    estimator = Estimator(Evaluator(run.member()), model, scales_of(model, new))
    item = new.items[0]
    start = estimator.start(item)
    assert start.origin == "estimated"
    assert abs(start.state[0] - true[0]) < 0.02, "fitted from the recognised start"
    one = Trajectory(item.label, 0.0, item.times[:1], item.values[:1], item.counts[:1], item.sd[:1], item.condition)
    assert recognised(run.member().weights, model, one) is None, "one row is too little"
    assert recognised({}, model, item) is None
