"""Constants per trajectory: the best minimum of each trajectory, with intervals wherever a fit is shown."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest

from gbspec.analysis import Estimator
from gbspec.arrays import Array
from gbspec.backends import Evaluator
from gbspec.data import scales_of
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import UserError
from gbspec.report import draw, run_summary
from gbspec.report.html import tables
from gbspec.runs import Run, open_run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

TEXT = """model waves
time t from 0
state phase
learn speed in [0.1, 12] per trajectory
learn size in [1e-3, 1e3] per trajectory
phase' = speed
initial phase = 0
observe y = size*sin(phase)
"""
TIMES = np.linspace(0.1, 4, 40)
SPEEDS, SIZES = (1.3, 3.1, 5.7, 9.9), (0.02, 0.5, 3.0, 40.0)
"""The error of a wave as a function of its speed has a local minimum for every turn."""


@cache
def waves(noise: float = 0.0) -> Trajectories:
    rng = np.random.default_rng(1)

    def values(speed: float, size: float) -> Array:
        return np.asarray(size * (np.sin(speed * TIMES) + noise * rng.standard_normal(len(TIMES))))

    items = [
        trajectory(f"wave {i}", 0.0, TIMES, values(speed, size)[:, None], [])
        for i, (speed, size) in enumerate(zip(SPEEDS, SIZES, strict=True))
    ]
    return Trajectories(tuple(items), ("y",))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    from tests.quick import fits

    folder = tmp_path_factory.mktemp("waves")
    with fits(folder / "cache"):
        return train(model_of(TEXT), waves(0.02), TrainOptions(effort="low", max_step=0.1, threads=1), folder / "run")


def test_each_trajectory_has_its_best_minimum_and_an_interval(run: Run) -> None:
    fit = open_run(run.path).fit
    for name, truths in (("speed", SPEEDS), ("size", SIZES)):
        own = fit.constants[name].per_trajectory
        assert own is not None and list(own) == [f"wave {i}" for i in range(4)]
        for one, truth in list(zip(own.values(), truths, strict=True))[2:]:  # smaller waves drown in the common scale
            assert one.value == pytest.approx(truth, rel=0.02)
            assert one.sd is not None and one.interval is not None
            assert one.interval[0] < one.value < one.interval[1]
    entry = json.loads((run.path / "fit.json").read_text())["constants"]["speed"]
    assert set(entry["per_trajectory"]["wave 3"]) == {"value", "sd", "interval"}


def test_it_is_shown(run: Run) -> None:
    lines = run_summary(run).splitlines()
    assert any(line.split() == ["trajectory", "speed", "interval", "size", "interval"] for line in lines)
    (last,) = (line.removeprefix("wave 3").split() for line in lines if line.startswith("wave 3"))
    assert float(last[0]) == pytest.approx(9.9, abs=0.05)
    assert float(last[1]) < float(last[0]) < float(last[3])
    assert len(tables.own_constants(run).rows) == 8
    figure = draw("per-trajectory", run, waves(0.02))
    assert len(figure.axes) == 2


def test_a_run_without_any_says_so(run: Run) -> None:
    from dataclasses import replace

    shared = {name: replace(entry, per_trajectory=None) for name, entry in run.fit.constants.items()}
    with pytest.raises(UserError, match="no constant `per trajectory`"):
        draw("per-trajectory", replace(run, fit=replace(run.fit, constants=shared)), waves(0.02))


def test_new_trajectories_have_their_best_minimum(run: Run) -> None:
    """From the mean of the training trajectories, as from most points, the speed stays in a wrong minimum."""
    opened = open_run(run.path)
    values = 7.0 * np.sin(7.3 * TIMES)
    new = Trajectories((trajectory("new", 0.0, TIMES, values[:, None], []),), ("y",))
    estimator = Estimator(Evaluator(opened.members[0]), opened.model, scales_of(opened.model, new))
    start = estimator.start(new.items[0])
    assert start.constants == pytest.approx([7.3, 7.0], rel=1e-2)
