"""Fits without networks: a ridge has no weights, and solutions that blow up give no warnings of numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import Trajectories
from gbspec.training import TrainOptions, train
from gbspec.training.runs.unused import said_of_unused
from tests.training.conftest import model_of, trajectory

DECAY = "model decay\nstate x in [0, 10]\nlearn k = 0.5 in [0.01, 20]{more}\nx' = -k*x\nobserve x{noise}\n"
OWN = " per trajectory ~ normal"


def decays(step: float) -> Trajectories:
    times, random = step * np.arange(8), np.random.default_rng(2)
    items = [
        trajectory(str(i), 0.0, times, (3 * np.exp(-times / step / 3) + 0.02 * random.normal(size=8))[:, None], [])
        for i in range(3)
    ]
    return Trajectories(tuple(items), ("x",))


@pytest.mark.parametrize(("more", "noise", "method"), [(OWN, " noise normal(0.02)", "auto"), ("", "", "lm")])
def test_a_ridge_without_weights_is_none(tmp_path: Path, more: str, noise: str, method: str) -> None:
    model = model_of(DECAY.format(more=more, noise=noise))
    options = TrainOptions(effort="low", ridge=1.0, method=method, workers=1)
    run = train(model, decays(0.5), options, tmp_path / "run")
    assert run.fit.constants["k"].value == pytest.approx(2 / 3, rel=0.1)
    assert any(text.startswith("`--ridge` had no effect") for text in run.fit.warnings)


def test_options_that_a_fit_did_not_use_are_named() -> None:
    options = TrainOptions(ridge=0.0, output_scale=2.0, quadrature=3, learning_rate=0.1)
    told = said_of_unused(options, model_of(DECAY.format(more="", noise="")), {"least squares"})
    names = ["--ridge", "--output-scale", "--quadrature", "--learning-rate"]
    assert [text.split("`")[1] for text in told] == names
    population = model_of(DECAY.format(more=OWN, noise=" noise normal(0.02)"))
    assert [text.split("`")[1] for text in said_of_unused(options, population, {"adam"})] == names[:2]
    assert said_of_unused(TrainOptions(), population, set()) == []


@pytest.mark.parametrize(
    ("options", "stages", "unused", "of_population"),
    [
        (TrainOptions(epochs=5), set(), ["--epochs"], ["--epochs"]),
        (TrainOptions(method="lm", epochs=5), set(), [], ["--method", "--epochs"]),
        (TrainOptions(forcing="autoregressive"), set(), [], ["--forcing"]),
        (TrainOptions(initial="bred"), set(), ["--initial"], ["--initial"]),
        (TrainOptions(initial="bred"), {"bred initial states"}, [], []),
    ],
)
def test_options_of_least_squares_are_none_of_likelihoods(
    options: TrainOptions, stages: set[str], unused: list[str], of_population: list[str]
) -> None:
    for model, expected in (
        (model_of(DECAY.format(more="", noise="")), unused),
        (model_of(DECAY.format(more=OWN, noise=" noise normal(0.02)")), of_population),
    ):
        assert [text.split("`")[1] for text in said_of_unused(options, model, stages)] == expected


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_rows_thousands_of_times_of_decay_apart_give_no_warnings_of_numpy(tmp_path: Path) -> None:
    run = train(model_of(DECAY.format(more="", noise="")), decays(1000.0), TrainOptions(workers=1), tmp_path / "run")
    assert run.fit.warnings
