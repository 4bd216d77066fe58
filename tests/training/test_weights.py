"""Channels count by their information: their noise is estimated where it is not stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data import Estimated, Trajectories, read, scales_of, unstated
from gbspec.diagnostics import Findings
from gbspec.report import run_summary
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from gbspec.training.recipe import build_context
from gbspec.training.recipe.weighing import CLEAN, share_of, unsettled
from gbspec.training.runs.member import Interrupted
from tests.training.conftest import Recorder, model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

REACTION = """
model reaction
time t
state S
state H
learn k = 0.5 in [0.05, 5]
learn h = 2 in [0.1, 50]
learn l = 1 in [0.1, 10]
S' = -k*S
H' = h*k*S - l*H
initial S = 2
initial H = 0
observe S{0}
observe H{1}
"""
LEARNED = REACTION.replace("learn k = 0.5 in [0.05, 5]", "unknown r(S) >= 0 by mlp(8, 8)").replace("k*S", "r(S)")
K, H, L = 0.8, 5.0, 1.5
DEVIATION = np.array([0.6, 1.2])


def states(times: np.ndarray) -> np.ndarray:
    """The true states."""
    s = 2 * np.exp(-K * times)
    return np.stack([s, 2 * H * K / (L - K) * (np.exp(-K * times) - np.exp(-L * times))], axis=1)


def logged(noise: tuple[float, float], seed: int = 0, dense: int = 240, few: int = 12) -> Trajectories:
    """One state measured now and then, the other one logged."""
    times = np.linspace(0, 5, dense + 1)[1:]
    error = np.random.default_rng(seed).standard_normal((dense, 2)) * noise * DEVIATION
    values = states(times) + error
    values[~np.isin(np.arange(dense), np.linspace(0, dense - 1, few).round()), 0] = np.nan
    return Trajectories((trajectory("1", 0.0, times, values, []),), ("S", "H"))


def fitted(text: str, data: Trajectories, path: Path, **options: object) -> Run:
    return train(model_of(text), data, TrainOptions(workers=1, effort="low", max_step=0.1, **options), path)  # type: ignore[arg-type]


NOISE = (0.01, 0.3)
STATED = tuple(f" noise normal({a * b:g})" for a, b in zip(NOISE, DEVIATION, strict=True))


def test_a_logged_channel_does_not_outweigh_a_sparse_one(tmp_path: Path) -> None:
    data = logged(NOISE)
    run = fitted(REACTION.format("", ""), data, tmp_path / "run")
    told = fitted(REACTION.format(*STATED), data, tmp_path / "told")
    for name, constant in run.fit.constants.items():
        sd, other = constant.sd, told.fit.constants[name]
        assert sd is not None and other.sd is not None
        assert sd == pytest.approx(other.sd, rel=0.35)
        assert abs(constant.value - other.value) < 0.5 * other.sd
    assert "channel weights" in [stage.name for stage in run.fit.members[0].stages]
    assert "channel weights" not in [stage.name for stage in told.fit.members[0].stages]
    channels = run.fit.members[0].channels
    assert channels is not None and channels["S"].weight is not None and channels["H"].weight is not None
    assert channels["S"].weight / channels["H"].weight == pytest.approx((0.3 / 0.01) ** 2, rel=0.7)
    assert (channels["S"].values, channels["H"].values) == (12, 240)
    assert "weight" in run_summary(run) and "240" in run_summary(run)
    scales, estimated = run.fit.scales, run.fit.members[0].estimated(run.model)
    assert scales is not None and estimated is not None
    np.testing.assert_allclose(scales.channel, scales_of(run.model, data, estimated).channel)


def test_networks_too(tmp_path: Path) -> None:
    run = fitted(LEARNED.format("", ""), logged(NOISE), tmp_path / "run")
    rmse, channels = run.fit.members[0].rmse["S"], run.fit.members[0].channels
    assert rmse is not None and rmse < 1.5 * NOISE[0] * DEVIATION[0]
    assert channels is not None and channels["S"].noise == pytest.approx(NOISE[0] * DEVIATION[0], rel=0.5)


def test_exact_channels_keep_their_weights(tmp_path: Path) -> None:
    run = fitted(REACTION.format("", ""), logged((0.0, 0.0)), tmp_path / "run")
    assert "channel weights" not in [stage.name for stage in run.fit.members[0].stages]
    channels = run.fit.members[0].channels
    assert channels is not None and channels["S"].noise is None and channels["S"].weight == pytest.approx(1.0)
    assert CLEAN < 0.01


def test_an_interrupted_fit_continues_with_its_weights(tmp_path: Path) -> None:
    text, data = REACTION.format("", ""), logged(NOISE, dense=100, few=10)
    whole = fitted(text, data, tmp_path / "whole")
    stages = whole.fit.members[0].stages
    before = sum(stage.iterations for stage in stages if stage.name != "channel weights")
    options = TrainOptions(workers=1, effort="low", max_step=0.1)
    with pytest.raises((Interrupted, KeyboardInterrupt)):
        train(model_of(text), data, options, tmp_path / "parts", Recorder(before + 2))
    parts = fitted(text, data, tmp_path / "parts", resume=True)
    assert parts.fit.constants == whole.fit.constants
    assert parts.fit.scales == whole.fit.scales
    for name, value in whole.member().weights.items():
        np.testing.assert_array_equal(parts.member().weights[name], value)


def test_only_channels_without_a_stated_noise_are_estimated() -> None:
    model, data = model_of(REACTION.format(STATED[0], "")), logged(NOISE)
    assert unstated(model, data).tolist() == [False, True]
    scales = scales_of(model, data, Estimated(np.array([9.0, 0.36]), np.array([0.1, 0.25])))
    noise = scales.channel * scales.level
    assert noise == pytest.approx([0.01 * DEVIATION[0], 0.36 / np.sqrt(0.25)])
    assert scales.noise is None


def test_residuals_that_follow_one_another_count_less() -> None:
    noise = np.random.default_rng(0).standard_normal(400)
    owner, drift = np.zeros(400, dtype=int), np.sin(np.linspace(0, 6, 400))
    assert share_of(noise, owner) == 1.0
    assert share_of(drift, owner) == pytest.approx(25 / 400), "25 values count at least"
    assert 0.2 < share_of(np.convolve(noise, np.ones(3) / 3, "same"), owner) < 0.4
    assert share_of(drift, np.arange(400)) == 1.0, "residuals of different trajectories"


@pytest.mark.parametrize(("rows", "ratio", "expected"), [(20, 1.5, False), (20, 2.0, True), (200, 1.5, True)])
def test_weights_are_introduced_where_noises_differ_beyond_chance(rows: int, ratio: float, expected: bool) -> None:
    """The logarithm of the ratio of two standard deviations from 20 values each is known to 0.22; log 1.5 = 0.41."""
    model, data = model_of(REACTION.format("", "")), logged((0.05, 0.05), dense=rows, few=rows)
    context = build_context(model, load_module(model), data, TrainOptions(backend="torch"), 0)
    noise = context.problem().scaling.channel * np.array([1.0, ratio])
    assert unsettled(context, Estimated(0.05 * noise, np.ones(2))) == expected


def test_replicates_with_standard_deviations_count_as_single_values(tmp_path: Path) -> None:
    """Four values 1 and a value 2, all with 0.2: the mean is 1.2 (the average counted sixteen times before: 1.06)."""
    lines = ["trajectory,t,name,value,sd", *["1,1,x,1,0.2"] * 4, "1,2,x,2,0.2"]
    (tmp_path / "d.csv").write_text("\n".join(lines))
    model = model_of("model m\ntime t from 0\nstate x\nlearn a = 0.5 in [-5, 5]\nx' = 0*a\ninitial x = a\nobserve x\n")
    run = train(model, read(tmp_path / "d.csv", model, Findings()), TrainOptions(workers=1), tmp_path / "run")
    assert run.fit.constants["a"].value == pytest.approx(1.2, abs=1e-6)
