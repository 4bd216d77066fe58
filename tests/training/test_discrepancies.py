"""Normalised prediction distribution errors: exact for linear models, and telling for wrong ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from gbspec.operations import models
from gbspec.report import draw
from gbspec.report.text import population_lines
from gbspec.training import TrainOptions, train
from gbspec.training.population import examined
from gbspec.training.population.discrepancies import prediction_errors
from tests.training.test_populations import levels

SUBJECTS, TIMES = 60, 4


def drawn(random: np.random.Generator, count: int, spread: float, noise: float) -> np.ndarray:
    """Values of `count` populations with levels around 5."""
    level = 5 + spread * random.standard_normal((count, SUBJECTS, 1))
    return (level + noise * random.standard_normal((count, SUBJECTS, TIMES))).reshape(count, -1)


OWNER = np.repeat(np.arange(SUBJECTS), TIMES)


def test_errors_of_a_linear_model_are_its_decorrelated_residuals() -> None:
    random = np.random.default_rng(1)
    value, simulated = drawn(random, 1, 1.5, 0.4)[0], drawn(random, 4000, 1.5, 0.4)
    found = prediction_errors(OWNER, value, simulated, np.ones(len(value), dtype=bool))
    factor = np.linalg.cholesky(1.5**2 * np.ones((TIMES, TIMES)) + 0.4**2 * np.eye(TIMES))
    exactly = np.linalg.solve(factor, (value.reshape(SUBJECTS, TIMES) - 5).T).T.ravel()
    moderate = np.abs(exactly) < 2.5
    assert found[moderate] == pytest.approx(exactly[moderate], abs=0.15)
    assert np.abs(found).max() <= norm.ppf(1 - 1 / 8000) + 1e-12


@pytest.mark.parametrize(("spread", "noise", "right"), [(1.5, 0.4, True), (0.7, 0.4, False), (1.5, 0.7, False)])
def test_wrong_distributions_are_told(spread: float, noise: float, right: bool) -> None:
    random = np.random.default_rng(2)
    value = drawn(random, 1, 1.5, 0.4)[0]
    simulated = drawn(random, 1000, spread, noise)
    found = examined(prediction_errors(OWNER, value, simulated, np.ones(len(value), dtype=bool)))
    assert found is not None
    assert found.n == SUBJECTS * TIMES
    assert (found.p > 0.05) == right


def test_solutions_that_blow_up_are_left_out_whatever_size_fixed_steps_give_them() -> None:
    random = np.random.default_rng(4)
    value, simulated = drawn(random, 1, 1.0, 0.5)[0], drawn(random, 200, 1.0, 0.5)
    known = np.ones(len(value), dtype=bool)
    failed = simulated.copy()
    failed[:3, :] = np.nan
    expected = prediction_errors(OWNER, value, failed, known)
    for size in (1e20, 1e200):
        failed[:3, :] = size * random.uniform(1, 2, failed[:3].shape)
        assert prediction_errors(OWNER, value, failed, known) == pytest.approx(expected)


def test_limits_and_solutions_that_fail_are_left_out() -> None:
    random = np.random.default_rng(3)
    value, simulated = drawn(random, 1, 1.0, 0.5)[0], drawn(random, 200, 1.0, 0.5)
    known = np.ones(len(value), dtype=bool)
    known[1] = False
    simulated[:50, 0] = np.nan
    simulated[:, 4:8] = np.nan
    found = prediction_errors(OWNER, value, simulated, known)
    assert np.isnan(found[[1, 4, 5, 6, 7]]).all()
    assert np.isfinite(np.delete(found, [1, 4, 5, 6, 7])).all()
    assert examined(found[:7]) is None


def test_a_run_keeps_them_and_draws_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.population.results.REPLICATES", 200)
    model, data, _ = levels(tmp_path)
    options = TrainOptions(backend="torch", max_step=1.0, effort="low")
    train(model, data, options, tmp_path / "run")
    run = models.open_run(tmp_path / "run")
    assert run.fit.population is not None
    found = run.fit.population.npde["x"]
    assert found.n == 32
    assert found.mean == pytest.approx(0, abs=0.4)
    assert found.p > 0.01
    assert any("prediction errors of x" in line for line in population_lines(run))
    states = tuple(replace(state, unit="mg/L") for state in run.model.states)
    run = replace(run, model=replace(run.model, states=states))
    for kind in ("npde", "cwres", "vpc"):
        axes = draw(kind, run, data).axes
        labels = [label for one in axes for label in (one.get_xlabel(), one.get_ylabel())]
        assert any(label.endswith("[mg/L]") for label in labels), "the unit is that of the state"
