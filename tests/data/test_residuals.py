"""The residual of a measured value that training minimises, also for log-normal noise."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec import frontend
from gbspec.data.sampling import SimulateOptions
from gbspec.data.statistics import deviations
from gbspec.diagnostics import Findings
from gbspec.ir.residual import logarithmic, residuals
from gbspec.operations import models, tables

TEXT = """\
model growth
state X in [0, 10] = 1
state S in [0, 10] = 5
X' = 0.3*S*X/(1 + S)
S' = -S*X/(1 + S)
observe X noise lognormal(0.1)
observe S
initial X = 1
initial S = 5
"""


def test_what_was_not_measured_has_none() -> None:
    found = residuals(np.array([[1.0, 2.0]]), np.array([[np.nan, 4.0]]), np.array([1.0, 0.5]), np.array([False, True]))
    assert np.isnan(found[0, 0])
    assert found[0, 1] == pytest.approx(np.log(0.5) / 2.0)


def test_scales_are_of_logarithms_where_residuals_are(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("residuals") / "growth.gb"
    path.write_text(TEXT)
    model = frontend.load_model(path, Findings())
    data = tables.simulate(models.reference(model), SimulateOptions(trajectories=3, span=4.0, keep_start=True))
    values = np.concatenate([item.values for item in data.items])
    assert logarithmic(model).tolist() == [True, False]
    np.testing.assert_allclose(deviations(model, data), [np.log(values[:, 0]).std(), values[:, 1].std()])
