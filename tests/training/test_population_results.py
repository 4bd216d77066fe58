"""What the results of a population say: spreads that data do not show, certainty, the number of weights that count."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.diagnostics import Findings
from gbspec.operations import tables
from gbspec.training import TrainOptions, train
from gbspec.training.population import marginal
from gbspec.training.population.results import effective_weights, inverse
from tests.training.test_populations import LEVEL, model_of, table


@pytest.mark.usefixtures("quick_fit")
@pytest.mark.parametrize(("share", "said"), [(1.15, True), (6.0, False)])
def test_a_spread_that_is_not_told_apart_from_none_is_named(tmp_path: Path, share: float, said: bool) -> None:
    """Means of four values differ by `share` of the variance that their noise alone would give."""
    within = np.array([1.0, -1.0, 1.0, -1.0]) * np.sqrt(0.75)
    values = 5 + np.where(np.arange(8) % 2, 1.0, -1.0)[:, None] * np.sqrt(share / 4) + within
    model = model_of(LEVEL, tmp_path)
    data = tables.read_data(table(tmp_path, values, np.arange(1.0, 5.0)), model, Findings())
    fit = train(model, data, TrainOptions(), tmp_path / "run").fit
    assert fit.population is not None
    assert fit.population.effects["m"].sd == pytest.approx(np.sqrt((share - 1) / 4), rel=0.01)
    assert any("the spread of `m`" in text and "not told apart from none" in text for text in fit.warnings) is said


def test_the_information_of_spreads_is_that_of_a_normal_distribution() -> None:
    """Two trajectories with two deviations; every parameter moves one entry of the factor, or the noise."""
    rng = np.random.default_rng(1)
    owner, f, variance = np.array([0, 0, 0, 1, 1]), rng.normal(size=(5, 2)), rng.uniform(1, 2, 5)
    factor = np.linalg.cholesky(np.array([[2.0, 0.3], [0.3, 1.0]]))
    moved = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], [[0.0, 0.0], [1.0, 0.0]], np.zeros((2, 2))])
    noise = np.stack([*np.zeros((3, 5)), np.ones(5)], axis=1)
    spread = {p: f @ moved[p] for p in range(3)}
    parts = marginal._Linearised(np.zeros((5, 4)), variance, f @ factor, spread, noise, np.zeros((5, 4)))
    found = marginal._information(owner, parts, np.arange(5))
    expected = np.zeros((4, 4))
    for rows in (owner == 0, owner == 1):
        inverse = np.linalg.inv(np.diag(variance[rows]) + f[rows] @ factor @ factor.T @ f[rows].T)
        each = [
            inverse @ (np.diag(noise[rows, p]) + f[rows] @ (moved[p] @ factor.T + factor @ moved[p].T) @ f[rows].T)
            for p in range(4)
        ]
        expected += 0.5 * np.array([[np.trace(a @ b) for b in each] for a in each])
    assert np.allclose(found, expected)
    assert (np.diag(found) > 0).all()


def test_a_parameter_without_information_takes_no_certainty_from_the_others() -> None:
    found = inverse(np.array([[4.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 4.0]]))
    assert np.isnan(found[1]).all() and np.isnan(found[:, 1]).all()
    np.testing.assert_allclose(found[np.ix_([0, 2], [0, 2])], np.linalg.inv([[4.0, 1.0], [1.0, 4.0]]))


@pytest.mark.parametrize("ridge", [1e-6, 0.3, 1e4])
def test_the_effective_number_of_weights_is_at_most_their_number(ridge: float) -> None:
    """Weights and parameters that stand for one another must not count twice."""
    random = np.random.default_rng(1)
    rows = random.standard_normal((6, 5))
    rows[:, 4] = rows[:, :3].sum(axis=1) + 1e-3 * rows[:, 4]
    information = rows.T @ rows
    prior = np.diag([ridge] * 3 + [0.0] * 2)
    inverse = np.linalg.inv(information + prior)
    found = effective_weights(inverse[:3, :3], ridge)
    assert found == pytest.approx(np.trace(inverse @ information) - 2, abs=1e-6)
    assert 0 <= found <= 3
    assert effective_weights(np.full((3, 3), np.nan), ridge) == 3
