"""Kinds of data that users bring: held inputs, hidden states, missing starts, long runs, few rows, noise in proportion.

Each is simulated from a model with a truth and fitted as `gbspec train` does it without options, but for the effort.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import gbspec
from gbspec.data.trajectories import Trajectories
from gbspec.frontend import resolve
from gbspec.runs import quantile
from gbspec.studies.heldout import Point, errors

DECAY = """model decay
state N in [1, 100] = 50
learn k = 0.3 in [0.01, 3]
N' = -k*N
observe N{noise}
truth k = 0.8
"""


def fitted(
    tmp_path: Path, text: str, change: Callable[[pl.DataFrame], pl.DataFrame] | None = None, **simulated: Any
) -> tuple[Any, Trajectories]:
    """The run of a model's text on data simulated from its truth, the table perhaps changed before; and the data."""
    (tmp_path / "m.gb").write_text(text)
    model = gbspec.load(tmp_path / "m.gb")
    table = tmp_path / "data.csv"
    data = model.simulate(table, **simulated)
    if change is not None:
        change(pl.read_csv(table)).write_csv(table)
    return model.train(table, tmp_path / "run", effort="low", threads=1, workers=1), data


def shipped(name: str, net: str, small: str) -> str:
    """The text of a bundled model with a smaller network."""
    text = resolve(name).read_text()
    assert net in text
    return text.replace(net, small)


@pytest.mark.usefixtures("quick_fit")
def test_an_input_held_between_samples_and_a_start_that_is_missing(tmp_path: Path) -> None:
    def without_b(table: pl.DataFrame) -> pl.DataFrame:
        first = pl.when(pl.col("t") == 0).then(None).otherwise(pl.col("B"))
        return table.with_columns(first.alias("B"))

    text = shipped("van_de_vusse", "mlp(24, 24)", "mlp(8, 8)")
    box = {"A": (0.5, 9.0), "B": (0.0, 1.5)}
    run, data = fitted(tmp_path, text, without_b, trajectories=4, span=5, dt=0.25, keep_start=True, initial=box, seed=1)
    assert all(len(np.unique(item.inputs[0].values)) > 2 for item in data.items), "the flow steps"
    constants = run.run.fit.constants
    assert constants["k1"].value == pytest.approx(50 / 60, rel=1e-3)
    assert constants["k2"].value == pytest.approx(100 / 60, rel=1e-3)
    starts = np.array([item.values[0] for item in data.items])
    found = run.run.member().weights["initial"]
    assert found[:, 0] == pytest.approx(starts[:, 0], rel=1e-12), "measured without noise, so believed"
    assert found[:, 1] == pytest.approx(starts[:, 1], abs=5e-3), "not measured, so learned"
    assert all("strongly correlated" in warning for warning in run.run.fit.warnings)


@pytest.mark.usefixtures("quick_fit")
def test_one_channel_of_two_states(tmp_path: Path) -> None:
    text = shipped("one_compartment", "mlp(16, 16)", "mlp(8)")
    run, _ = fitted(tmp_path, text, trajectories=5, span=16, dt=1, sampling="gamma", noise=0.02, seed=1)
    assert run.run.fit.constants["ka"].value == pytest.approx(1.2, rel=0.05)
    conc = np.linspace(0.5, 8, 50)
    found = function(run, "elimination", conc)
    truth = 1.8 * conc / (4 + conc)
    assert np.abs(found - truth).max() < 0.06 * np.ptp(truth)
    assert run.run.fit.warnings == ()


@pytest.mark.usefixtures("quick_fit")
def test_thousands_of_even_samples_of_one_run(tmp_path: Path) -> None:
    text = shipped("friction_oscillator", "mlp(24, 24)", "mlp(8)")
    run, data = fitted(tmp_path, text, trajectories=1, span=60, dt=0.05, keep_start=True, seed=1)
    assert data.measurements == 2402
    assert run.run.fit.constants["k"].value == pytest.approx(4, rel=2e-3)
    rmse = run.run.fit.members[0].rmse  # of the solution from the start to the end
    assert all(rmse[name] < 0.05 * data.items[0].values[:, j].std() for j, name in enumerate(("q", "w")))


@pytest.mark.usefixtures("quick_fit")
def test_fifty_noisy_rows_predict_what_lies_between_them(tmp_path: Path) -> None:
    text = shipped("lotka_volterra", "mlp(32, 32)", "mlp(8, 8)")
    box = {"prey": (10.0, 60.0), "predator": (5.0, 30.0)}
    how = {"trajectories": 4, "span": 12, "keep_start": True, "initial": box, "seed": 1}
    run, data = fitted(tmp_path, text, dt=1, noise=0.03, **how)
    assert sum(len(item.times) for item in data.items) == 52
    model, seen = gbspec.load(tmp_path / "m.gb"), run.run.member().weights["initial"]
    exact, found = model.simulate(dt=0.05, **how), learned_solutions(run, seen, np.arange(0, 12.01, 0.05))
    sd = np.concatenate([item.values for item in exact.items]).std(axis=0)
    for truth, learned in zip(exact.items, found, strict=True):
        error = (learned - truth.values) / sd
        assert (np.sqrt((error**2).mean(axis=0)) < 0.04).all() and np.abs(error).max() < 0.12, "noise is 0.03"
        turns = [np.sum(np.diff(np.sign(np.diff(values, axis=0)), axis=0) != 0) for values in (learned, truth.values)]
        assert turns[0] == turns[1], "as often up and down as the truth"


def function(run: Any, name: str, values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A learned function of one argument."""
    import torch

    with torch.no_grad():
        return np.asarray(run.run.member().functions[name](torch.from_numpy(values)[:, None]).numpy().ravel())


def learned_solutions(
    run: Any, starts: np.ndarray[Any, Any], times: np.ndarray[Any, Any]
) -> list[np.ndarray[Any, Any]]:
    """Solutions [T, n_states] of the learned model from each start."""
    from gbspec.backends.casadi.evaluator import Evaluator

    evaluator = Evaluator(run.run.member())
    return [evaluator.integrate(start, times, np.zeros(0), (), 0.0, rtol=1e-8, atol=1e-8) for start in starts]


@pytest.mark.usefixtures("quick_fit")
def test_noise_in_proportion_gives_intervals_in_proportion(tmp_path: Path) -> None:
    text = DECAY.format(noise=" noise lognormal(0.2)")
    run, data = fitted(tmp_path, text, trajectories=4, span=5, dt=0.5, keep_start=True, noise=0.2, seed=1)
    noise = run.run.fit.noise["N"]
    assert noise == pytest.approx(0.2, rel=0.3), "of the logarithm"
    seen = run.predict(data).items
    high, mean, low, measured = (
        np.concatenate([getattr(item, name)[:, 0] for item in seen]) for name in ("high", "mean", "low", "measured")
    )
    factor = np.exp(quantile(run.run.fit.members[0].freedom) * noise)
    assert high / mean == pytest.approx(mean / low, rel=1e-9)
    assert high / mean == pytest.approx(factor, rel=0.05) and (high / mean > factor).all(), "the model's is added"
    assert 0.75 < np.mean((measured > low) & (measured < high)) < 0.99


def test_held_out_measurements_are_judged_in_proportion() -> None:
    points = [Point("1", t, "N", measured, 10.0, 2.0, True) for t, measured in enumerate((7.3, 7.1, 13.8, 14.0))]
    assert errors(points, {"N": 1.0})["N"].covered == 0.5, "within a factor of exp(1.645 * 0.2) = 1.39"


@pytest.mark.usefixtures("quick_fit")
def test_noisy_first_values_count_as_measurements_where_everything_is_known(tmp_path: Path) -> None:
    how = {"trajectories": 6, "span": 5, "dt": 0.5, "keep_start": True, "seed": 3}
    run, data = fitted(tmp_path, DECAY.format(noise=""), noise=0.1, **how)
    exact, found = gbspec.load(tmp_path / "m.gb").simulate(**how), run.run.member().weights["initial"][:, 0]
    off = np.array([[item.values[0, 0] for item in each.items] for each in (data, exact)])
    assert np.abs(found - off[1]).mean() < 0.8 * np.abs(off[0] - off[1]).mean()
    low, high = run.run.fit.constants["k"].interval
    assert low < 0.8 < high and high - low < 0.1
    assert run.run.fit.warnings == ()


@pytest.mark.usefixtures("quick_fit")
def test_exact_first_values_stay_where_everything_is_known(tmp_path: Path) -> None:
    run, data = fitted(tmp_path, DECAY.format(noise=""), trajectories=2, span=3, dt=0.5, keep_start=True, seed=3)
    assert run.run.fit.constants["k"].value == pytest.approx(0.8, abs=1e-5)
    assert run.run.member().weights["initial"][:, 0] == pytest.approx([i.values[0, 0] for i in data.items], rel=1e-12)
