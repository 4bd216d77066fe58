"""Tables that begin after the rows of the training, with the same labels, without these rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis.prediction.forecast import forecast
from gbspec.analysis.validation.validate import validate
from gbspec.data import Trajectories, Trajectory
from gbspec.operations import analysing
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

STOCK = "model stock\ntime t\nstate x in [0, 20]\nlearn k = 0.3 in [0.05, 5]\nx' = -k*x\nobserve x\n"
TIMES = np.arange(2000.0, 2012.0)


def measured(label: str, rows: slice) -> Trajectory:
    noise = 1 + 0.02 * np.random.default_rng(0).standard_normal(len(TIMES))
    values = (10 * np.exp(-0.2 * (TIMES - 2000)) * noise)[rows, None]
    return trajectory(label, float(TIMES[rows][0]), TIMES[rows], values, [])


def table(*items: Trajectory) -> Trajectories:
    return Trajectories(items, ("x",))


@pytest.mark.parametrize("more", ["initial x = 10\n", ""], ids=["given start", "measured start"])
def test_rows_that_go_on_without_those_of_the_training_are_told(tmp_path: Path, quick_fits: None, more: str) -> None:
    run = train(model_of(STOCK + more), table(measured("a", slice(8))), TrainOptions(), tmp_path / "run")
    words = "trajectory `a` begins at 2008, after the last row that the training had of this label (2007), and begins"
    cases = [
        (table(measured("a", slice(8, None))), bool(more)),
        (table(measured("a", slice(None))), False),  # with the rows of the training
        (table(measured("a", slice(8))), False),  # the training itself
        (table(replace(measured("a", slice(8, None)), label="b")), False),
    ]
    for data, said in cases:
        for found in (forecast(run, data), validate(run, data, truth=False)):
            texts = [text for text in found.warnings if text.startswith(words)]
            assert len(texts) == said
            assert all("the model gives the start of `x`. If it goes on with" in text for text in texts)


def test_so_they_are_of_a_model_with_disturbances(tmp_path: Path, quick_fits: None) -> None:
    model = model_of(STOCK + "initial x = 10\ndiffusion x = 0.1\n")
    run = train(model, table(measured("a", slice(8)), measured("b", slice(8))), TrainOptions(), tmp_path / "run")
    data = table(measured("a", slice(8, None)), measured("b", slice(9, None)))
    words = "trajectories `a`, `b` begin at 2008 (`a`), after the last row that the training had of these labels (2007)"
    for found in (analysing.predict(run, data), analysing.validate(run, data)):
        assert [text.startswith(words) for text in found.warnings].count(True) == 1
