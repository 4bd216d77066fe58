"""Disturbances that the data do not tell apart from none are named, with an interval that begins at none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.data import read
from gbspec.diagnostics import Findings
from gbspec.runs import Run
from gbspec.training import filter_run, train
from tests.filter.test_fits import DRIFT, FAST, model_in

TEXT = DRIFT.replace("observe X", "observe X noise normal(0.1)")


def fitted(folder: Path, size: float, text: str = TEXT) -> Run:
    """The fit to 40 rows with a disturbance of a size."""
    rng, x, lines = np.random.default_rng(5), 3.0, ["t,X"]
    a = np.exp(-0.2)
    for k in range(40):
        lines.append(f"{k * 0.2:.2f},{x + 0.1 * rng.standard_normal():.6f}")
        x = 1 + a * (x - 1) + size * np.sqrt((1 - a * a) / 2) * rng.standard_normal()
    model = model_in(folder, text)
    (folder / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return train(model, read(folder / "d.csv", model, Findings()), FAST, folder / "run")


def said(run: Run) -> list[str]:
    return [text for text in run.fit.warnings if "is not told apart from none" in text]


def test_none_is_the_lower_end_and_the_upper_end_is_where_the_likelihood_falls(tmp_path: Path) -> None:
    run = fitted(tmp_path, 0.03)
    (told,) = said(run)
    assert "the disturbance of `X`, `s` = " in told
    low, high = run.fit.constants["s"].interval or (np.nan, np.nan)
    assert low == 0.0
    assert run.fit.constants["s"].value < high < 0.3
    data = read(tmp_path / "d.csv", run.model, Findings())
    filtered = filter_run(run, data, 0)
    engine, vector = filtered.engine, filtered.vector.copy()
    maps, restricted = engine.parameters.bijections((2,)), []
    for size in (1e-4, run.fit.constants["s"].value, high):
        vector[2] = maps.from_natural(np.array([size]))[0]
        for _ in range(20):  # all else at its maximum, by scoring
            found = engine.information(vector)
            vector[:2] -= np.linalg.solve(found.matrix[:2, :2], found.gradient[:2])
        restricted.append(2 * engine.value(vector) + np.linalg.slogdet(found.matrix[:2, :2])[1])
    assert restricted[2] - min(restricted[:2]) == pytest.approx(2.7, abs=0.3)


def test_a_clear_disturbance_has_the_interval_of_its_curvature(tmp_path: Path) -> None:
    run = fitted(tmp_path, 0.5)
    assert not said(run)
    assert (run.fit.constants["s"].interval or (0.0, 0.0))[0] > 0.2


def test_one_that_cannot_be_small_is_not_compared_with_none(tmp_path: Path) -> None:
    assert not said(fitted(tmp_path, 0.03, TEXT.replace("s = 0.3 in [0, 5]", "s = 0.3 in [0.02, 5]")))


OFFSETS = """model offsets
time t from 0
state d in [-5, 5] = 0
learn g = 1 in [-5, 5]
learn b = 1 in [-5, 5] per trajectory
learn s = 0.3 in [0.001, 5]
d' = -2*d
initial d = 0
diffusion d = s
observe y = g*t + b + d noise normal(0.15)
"""


def test_constants_of_trajectories_are_integrated_beside_one_that_shifts_readings(tmp_path: Path) -> None:
    rng, lines = np.random.default_rng(22), ["trajectory,t,y"]
    for i in range(16):
        d, b = 0.0, rng.standard_normal()
        for k in range(4):
            if k:
                d = d * np.exp(-0.8) + np.sqrt(0.18**2 / 4 * (1 - np.exp(-1.6))) * rng.standard_normal()
            lines.append(f"{i},{0.4 * k:.4g},{0.4 * k + b + d + 0.15 * rng.standard_normal():.6g}")
    model = model_in(tmp_path, OFFSETS)
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    run = train(model, read(tmp_path / "d.csv", model, Findings()), FAST, tmp_path / "run")
    low, high = run.fit.constants["s"].interval or (np.nan, np.nan)
    assert low < run.fit.constants["s"].value < high  # without them it ended at 0.166, below the estimate of 0.201
