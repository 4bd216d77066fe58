"""`--holdout` stops in time: a network that goes on to fit the noise is kept as it was when it predicted best."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import gbspec
from gbspec.training.recipe.context import split

pytestmark = pytest.mark.usefixtures("quick_fits")

TEXT = """\
model m
state N in [0, 2] = 1
unknown rate(N) by mlp(16)
N' = -rate(N)
observe N
truth rate(N) = 0.7*N
"""


def off(run: gbspec.api.FittedRun) -> float:
    """How far what was learned is from the truth, as a root of the mean square over most of the data's range."""
    points = torch.linspace(0.4, 1.6, 30, dtype=torch.float64)
    return float(torch.sqrt(torch.mean((run.member(0).functions["rate"](points) - 0.7 * points) ** 2)))


@pytest.mark.parametrize(("trajectories", "dt", "noise", "seed"), [(4, 0.25, 0.2, 1), (1, 0.1, 0.1, 0)])
def test_held_out_data_keep_a_network_from_fitting_noise(
    tmp_path: Path, trajectories: int, dt: float, noise: float, seed: int
) -> None:
    """Whole trajectories are held out, of a single one its last rows; the other fit sees the same rows to the end."""
    (tmp_path / "m.gb").write_text(TEXT)
    model = gbspec.load(tmp_path / "m.gb")
    data = model.simulate(trajectories=trajectories, span=2.0, dt=dt, initial={"N": (0.3, 2)}, noise=noise, seed=seed)
    kept, held = split(data, 0.3, 0)
    assert sum(item.times.size for item in kept.items) < sum(item.times.size for item in data.items) and len(held) == 1
    how = {"method": "lm", "epochs": 12, "ridge": 0.0, "warm_start": False, "threads": 1}
    stopped = model.train(data, tmp_path / "stopped", holdout=0.3, **how)
    to_the_end = model.train(kept, tmp_path / "end", **how)
    assert np.isfinite(off(stopped))
    assert off(stopped) < 0.5 * off(to_the_end)
