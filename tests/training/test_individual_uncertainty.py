"""Intervals of single trajectories contain the uncertainty of what they have in common."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.diagnostics import Findings
from gbspec.operations import tables
from gbspec.training import TrainOptions, train
from tests.training.test_populations import LEVEL, levels, model_of, table

SUBJECTS, VALUES, NOISE = 8, 4, 0.4


@pytest.mark.parametrize("spread", [1.5, 0.2, 1e-6])
def test_the_standard_deviation_of_a_trajectory_is_that_of_its_prediction(spread: float, tmp_path: Path) -> None:
    """With known variances the best linear unbiased prediction has a variance in closed form; where trajectories do not
    differ it is that of the median, not zero."""
    text = LEVEL.replace("normal(s)", f"normal({spread})").replace("normal(e)", f"normal({NOISE})")
    text = text.replace("learn s = 1 > 0\n", "").replace("learn e = 0.5 > 0\n", "")
    _, data, _ = levels(tmp_path)
    run = train(model_of(text, tmp_path), data, TrainOptions(workers=1, backend="torch"), tmp_path / "run")
    of_mean = NOISE**2 / VALUES
    share = spread**2 / (spread**2 + of_mean)
    median = (spread**2 + of_mean) / SUBJECTS
    assert not any("ended at zero" in text for text in run.fit.warnings), "a spread that is stated"
    record = run.fit.constants["m"]
    assert record.sd == pytest.approx(np.sqrt(median), rel=1e-3)
    expected = np.sqrt(spread**2 * (1 - share) + (1 - share) ** 2 * median)
    assert record.per_trajectory is not None and len(record.per_trajectory) == SUBJECTS
    for each in record.per_trajectory.values():
        assert each.sd == pytest.approx(expected, rel=1e-3)


def test_trajectories_that_do_not_differ_are_as_uncertain_as_their_median(tmp_path: Path) -> None:
    """The learned spread ends at zero, and its standard deviation on the scale of logarithms has any size."""
    random = np.random.default_rng(3)
    values = 5 + 0.4 * random.standard_normal((SUBJECTS, VALUES))
    values += 5 - values.mean(axis=1, keepdims=True) + 0.01 * random.standard_normal((SUBJECTS, 1))
    model = model_of(LEVEL, tmp_path)
    data = tables.read_data(table(tmp_path, values, np.arange(float(VALUES))), model, Findings())
    run = train(model, data, TrainOptions(workers=1, backend="torch"), tmp_path / "run")
    assert any("the spread of `m` between values of `trajectory` ended at zero" in text for text in run.fit.warnings)
    record = run.fit.constants["m"]
    assert run.fit.population is not None and run.fit.population.effects["m"].sd < 1e-3
    assert record.sd is not None and record.per_trajectory is not None
    for each in record.per_trajectory.values():
        assert each.sd == pytest.approx(record.sd, rel=0.02)


def test_predictions_of_a_population_contain_the_uncertainty_of_medians(tmp_path: Path) -> None:
    """Where the covariance is not known, as in an older run, no members are offered: they would end alike."""
    model, data, _ = levels(tmp_path)
    options = TrainOptions(workers=1, backend="torch", effort="low")
    train(model, data, options, tmp_path / "run")
    (tmp_path / "new.csv").write_text("trajectory,t,x\nnew,0,6.5\nnew,1,\n")
    found = gbspec.open_run(tmp_path / "run").predict(tmp_path / "new.csv")
    assert not [text for text in found.warnings if "too narrow" in text]
    (tmp_path / "run" / "members" / "0" / "covariance.safetensors").unlink()
    without = gbspec.open_run(tmp_path / "run").predict(tmp_path / "new.csv")
    (said,) = [text for text in without.warnings if "too narrow" in text]
    assert "medians" in said and "--members" not in said
    assert found.items[0].sd[1, 0] > without.items[0].sd[1, 0]
