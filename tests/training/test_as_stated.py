"""When a fit with a small R² follows its data to the noise that model or table state."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.report import run_summary
from gbspec.runs import ChannelRecord
from gbspec.training.runs.stated import to_stated_noise
from tests.training.conftest import model_of

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = "model m\ntime t from 0\nstate x in [-10, 10] = 0\nlearn k = 0.5 in [0.01, 3]\nx' = -k*x\ninitial x = 2\n"


@pytest.mark.parametrize(
    ("times", "record", "stated"),
    [
        (1.0, ChannelRecord(-0.05, 0.01, values=60), True),
        (1.0, ChannelRecord(-0.05, 0.01, values=60, lack_of_fit=0.3), True),
        (1.0, ChannelRecord(-0.05, 0.01, values=60, lack_of_fit=5e-6), False),
        (0.7, ChannelRecord(-0.05, 0.01, values=60), True),
        (0.7, ChannelRecord(-0.44, 0.08, values=60), False),
        (0.23, ChannelRecord(-0.05, 0.01, values=60), False),
        (0.23, ChannelRecord(-0.44, 0.08, values=60), False),
        (1.5, ChannelRecord(-0.05, 0.01, values=60), False),
        (1.0, ChannelRecord(-0.44, 0.08, values=60), False),
    ],
)
def test_a_noise_that_is_too_large_or_that_replicates_refute_excuses_nothing(
    times: float, record: ChannelRecord, stated: bool
) -> None:
    model = model_of(DECAY + "observe x noise normal(1)\n")
    assert bool(to_stated_noise(model, {"x": record}, {"x": times}, 59.0)) is stated
    assert not to_stated_noise(model, {"x": record}, {}, 59.0)


@pytest.mark.parametrize(("told", "noise", "stated"), [(60, "", True), (2, "", False), (2, " noise normal(1)", True)])
def test_each_value_needs_a_stated_noise(tmp_path: Path, told: int, noise: str, stated: bool) -> None:
    """A decay of which noise leaves little to be seen: R² is near 0."""
    (tmp_path / "m.gb").write_text(DECAY + f"observe x{noise}\n")
    t = 5 * np.arange(60.0)
    x = 2 * np.exp(-t) + np.random.default_rng(2).normal(size=60)
    sd = np.where(np.arange(60) < told, 1.0, np.nan)
    data = {"t": t, "x": x, "sd_x": sd}
    run = gbspec.load(tmp_path / "m.gb").train(data, tmp_path / "run", effort="low").run
    channels = run.fit.members[0].channels
    assert channels is not None and bool(channels["x"].as_stated) is stated
    assert ("R² of `x`: what is left is no larger than the stated noise" in run_summary(run)) is stated
