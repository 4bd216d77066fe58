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


KNOWN = """\
model m
state N in [0, 2] = 1
learn s in [0.001, 1] = 0.3
N' = -k*N
observe N noise normal(s)
"""
OF_EACH = "learn w in [0.01, 3] = 0.1\nlearn k in [0.01, 10] = 0.2 per trajectory ~ lognormal(w)\n"


@pytest.mark.parametrize(
    ("statements", "truth"),
    [
        (OF_EACH, {"k": 0.7, "w": 0.4, "s": 0.05}),
        (OF_EACH + "unknown more(N in [0, 2]) by mlp(3)\n", {"w": 0.4, "s": 0.05}),
        ("learn k in [0.01, 10] = 0.2\n", {"k": 0.7, "s": 0.05}),
    ],
)
def test_held_out_data_stop_no_likelihood_before_it_is_maximised(
    tmp_path: Path, statements: str, truth: dict[str, float]
) -> None:
    """The pooled fit was kept, whose spreads and noises are those of the starts, since the errors of typical solutions
    in held-out data are smallest there."""
    balance = "N' = more(N)" if "more" in statements else "N' ="
    (tmp_path / "m.gb").write_text(KNOWN.replace("N' =", statements + balance))
    model, random = gbspec.load(tmp_path / "m.gb"), np.random.default_rng(1)
    each = 0.7 * np.exp(("w" in truth) * 0.4 * random.standard_normal(16))
    times = np.linspace(0.0, 3, 9)
    rows = [(i, t, np.exp(-k * t) + 0.05 * random.standard_normal()) for i, k in enumerate(each) for t in times]
    (tmp_path / "d.csv").write_text("trajectory,t,N\n" + "".join(f"{i},{t},{x:.4f}\n" for i, t, x in rows))
    run = model.train(tmp_path / "d.csv", tmp_path / "run", holdout=0.25)
    for name, value in truth.items():
        assert run.constants[name] == pytest.approx(value, rel=0.4)
