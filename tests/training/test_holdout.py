"""`--holdout` stops in time: a network that goes on to fit the noise is kept as it was when it predicted best."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import gbspec
from gbspec.diagnostics import UserError
from gbspec.operations.comparing import Compared, Comparison, Ratio, compare
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


def table(path: Path) -> Path:
    random, times = np.random.default_rng(1), np.linspace(0.0, 3, 9)
    rows = [(i, t, np.exp(-0.7 * t) + 0.05 * random.standard_normal()) for i in range(8) for t in times]
    path.write_text("trajectory,t,N\n" + "".join(f"{i},{t},{x:.4f}\n" for i, t, x in rows))
    return path


def test_likelihoods_of_different_trajectories_are_not_compared(tmp_path: Path) -> None:
    """Those of one run's members, of which the best is taken, are of the same; other seeds hold out others."""
    (tmp_path / "m.gb").write_text(KNOWN.replace("N' =", "learn k in [0.01, 10] = 0.2\nN' ="))
    model, data = gbspec.load(tmp_path / "m.gb"), table(tmp_path / "d.csv")
    several = model.train(data, tmp_path / "several", holdout=0.25, members=2)
    first, second = (several.run.member(number).info["labels"] for number in (0, 1))
    assert isinstance(first, list) and len(first) == 6 and first == second
    other = model.train(data, tmp_path / "other", holdout=0.25, seed=1)
    assert other.run.member(0).info["labels"] != first
    with pytest.raises(UserError) as refused:
        compare([several.run, other.run])
    assert refused.value.diagnostics[0].code == "GB775"
    assert "were not fitted to the same rows" in refused.value.diagnostics[0].message


def test_a_larger_model_that_fits_worse_is_remarked_on() -> None:
    runs = tuple(Compared(name, "m", value, n, value + 2 * n, value) for name, value, n in [("a", 4, 1), ("b", 5, 2)])
    found = str(Comparison(runs, (Ratio("a", "b", -1.0, 1, 1.0, False),), {}))
    assert "b against a: -2 log L is higher by 1.000 with 1 further parameter" in found and "p =" not in found
