"""A learned start of a measured state lets the likelihood grow without limit as a learned noise goes to zero."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from gbspec.arrays import Array
from gbspec.data import read
from gbspec.diagnostics import Findings, UserError
from gbspec.operations import comparing
from gbspec.report import run_summary
from gbspec.runs import Run
from gbspec.training import train
from tests.filter.test_fits import DRIFT, FAST, STEPPED, data_in, model_in

LEARNED = "initial X learn\n"


def fitted(folder: Path, text: str, rows: int, noise: float) -> tuple[Run, Array, Array]:
    """The fit of a text to rows of the process, with their times and values."""
    model = model_in(folder, text)
    data = data_in(folder, model, rows, noise)
    (item,) = data.items
    return train(model, data, FAST, folder / "run"), item.times, item.values[:, 0]


def dense(at: Array, noise: float, times: Array, values: Array) -> float:
    """-2 log likelihood of the process by the covariance of all values, at the logarithms of theta and s; the start and
    mu, in which the values are linear, are the best ones."""
    theta, s = np.exp(at)
    left, between = times[:, None] + times, np.abs(times[:, None] - times)
    cov = s**2 / (2 * theta) * (np.exp(-theta * between) - np.exp(-theta * left)) + noise**2 * np.eye(len(times))
    root = np.linalg.cholesky(cov)
    by_start = np.exp(-theta * times)
    x, y = np.linalg.solve(root, np.stack([by_start, 1 - by_start], 1)), np.linalg.solve(root, values)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(rest @ rest + 2 * np.log(np.diag(root)).sum() + len(values) * np.log(2 * np.pi))


@pytest.mark.parametrize(
    ("text", "start"),
    [(DRIFT, "initial X learn"), (STEPPED, "initial X learn"), (DRIFT + "learn x0 = 1\n", "initial X = x0")],
)
def test_a_likelihood_without_a_maximum_is_told(tmp_path: Path, text: str, start: str) -> None:
    run, times, values = fitted(tmp_path, f"{text}{start}\n", 40, 0.0)
    if text == DRIFT:  # the likelihood itself grows by the noise's part of one value, without end
        best = [minimize(dense, [0.0, -0.7], (r, times, values), method="Nelder-Mead").fun for r in (1e-3, 1e-4, 1e-5)]
        assert np.diff(best) == pytest.approx(-2 * np.log(10), abs=0.01)
    found = run.fit.members[0].likelihood
    assert found is not None and found.unbounded == ("X",)
    assert found.least is None and found.aic is None and found.bic is None and found.minus2ll is not None
    assert found.noise["X"].interval is None
    assert "innovations; at the estimates" in run_summary(run)
    (told,) = [one for one in run.fit.warnings if "the likelihood has no maximum" in one]
    assert "noise of `X`" in told and f"`{start}`" in told
    with pytest.raises(UserError) as refused:
        comparing.compare([run, run])
    assert "has a likelihood without a maximum" in refused.value.diagnostics[0].message


def test_a_maximum_beside_it_is_one(tmp_path: Path) -> None:
    """The noise of many values shows: the fit is at a maximum, and its noise is as well known as those values tell."""
    run, times, values = fitted(tmp_path, DRIFT + LEARNED, 120, 0.3)
    found = run.fit.members[0].likelihood
    assert found is not None and found.unbounded is None and found.least is not None
    noise, constants = found.noise["X"], run.fit.constants
    first = np.log([constants["theta"].value or 1, constants["s"].value or 1, noise.value])
    best = minimize(lambda at: dense(at[:2], np.exp(at[2]), times, values), first, method="Nelder-Mead")
    assert found.least == pytest.approx(best.fun, abs=0.01)
    assert found.noise["X"].interval is not None
    assert not any("no maximum" in one for one in run.fit.warnings)


def test_what_the_rest_is_known_by_does_not_depend_on_the_noise_that_is_gone(tmp_path: Path) -> None:
    """The logarithm of a disturbance's size has the variance 1/2n of n increments, which trajectories share."""
    text = DRIFT.replace("learn mu = 0.5 in [-5, 5]", "const mu = 0").replace("X in [-5, 5] = 0", "X") + LEARNED
    text = text.replace("learn s = 0.3 in [0, 5]", "learn s = 0.5 in [0.01, 5]")
    model, rng = model_in(tmp_path, text), np.random.default_rng(7)
    lines = ["trajectory,t,X"]
    for i in range(5):
        x = 2.0
        for k in range(12):
            lines.append(f"{i},{0.2 * k:.1f},{x + 0.05 * rng.standard_normal():.4f}")
            x = np.exp(-0.14) * x + 0.4 * np.sqrt((1 - np.exp(-0.28)) / 1.4) * rng.standard_normal()
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    run = train(model, read(tmp_path / "d.csv", model, Findings()), FAST, tmp_path / "run")
    found = run.fit.members[0].likelihood
    assert found is not None and found.unbounded == ("X",)
    low, high = run.fit.constants["s"].interval or (1.0, 1.0)
    assert np.log(high / low) == pytest.approx(2 * 1.67 / np.sqrt(2 * 55), rel=0.15)
