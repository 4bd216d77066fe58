"""A wrong postulate is corrected, whichever way the network enters it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from gbspec.data.trajectories import Trajectories
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

WRONG = "0.7*x"
FORMS = {
    "additive": f"{WRONG} + nn",
    "multiplicative": f"{WRONG}*nn",
    "composed": f"{WRONG}*exp(nn)",
}


def rate(x: np.ndarray) -> np.ndarray:
    """The truth, which saturates where the postulate does not: at most 1.5 of the postulate, at least 0.55."""
    return 2.0 * x / (1.0 + x)


@cache
def decays() -> Trajectories:
    times = np.arange(0.0, 3.1, 0.3)
    items = []
    for i, start in enumerate((0.8, 1.8, 3.0)):
        found = solve_ivp(lambda t, x: -rate(x), (0, 3), [start], t_eval=times[:-1], rtol=1e-9, atol=1e-11)
        items.append(trajectory(str(i), 0.0, times[:-1], found.y.T, []))
    return Trajectories(tuple(items), ("x",), "made.csv", "0" * 64)


@pytest.mark.parametrize("form", FORMS)
def test_a_wrong_postulate_is_corrected(form: str, tmp_path: Path) -> None:
    text = f"model wrong\nstate x in [0, 4]\nunknown r(x) = {FORMS[form]} by mlp(8)\nx' = -r(x)\nobserve x\n"
    run = train(model_of(text), decays(), TrainOptions(method="lm", epochs=8, max_step=0.15), tmp_path / "run")
    x = np.linspace(0.3, 2.8, 40)
    with torch.no_grad():
        found = run.member().functions["r"](torch.from_numpy(x)[:, None]).numpy().ravel()
    size = np.abs(rate(x)).mean()
    assert np.abs(0.7 * x - rate(x)).mean() / size > 0.15, "the postulate is wrong"
    assert np.abs(found - rate(x)).mean() / size < 0.01
