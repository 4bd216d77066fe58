"""The residual of a measured value: the one that training makes small, also under log-normal noise."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gbspec import driver
from gbspec.data.residuals import LOG_FLOOR, deviations, logarithmic, residuals
from gbspec.data.sampling import SimulateOptions
from gbspec.diagnostics import Findings

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


def test_it_is_the_residual_of_training_wherever_a_value_was_measured() -> None:
    torch = pytest.importorskip("torch")
    from gbspec.training.engines.torch.unroll import residuals_of

    rng = np.random.default_rng(4)
    predicted, values = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    predicted[::7] *= 1e-4  # far below the floor of the logarithm
    values[:, 1] = np.abs(values[:, 1])
    weights = np.sqrt(rng.integers(0, 4, size=(200, 3)).astype(float))
    values[weights == 0] = np.nan
    scale, log = rng.uniform(0.1, 3.0, size=(200, 3)), np.array([False, True, True])
    problem = SimpleNamespace(
        packed=SimpleNamespace(weights=weights, values=values), scaling=SimpleNamespace(row_scale=scale, log=log)
    )
    expected = residuals_of(problem, torch.from_numpy(predicted)).numpy()  # type: ignore[arg-type]  # what it reads
    seen = weights > 0
    found = residuals(predicted, values, scale / np.where(seen, weights, np.nan), log)
    np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-12)
    assert (predicted / np.abs(values))[:, 1:][seen[:, 1:]].min() < LOG_FLOOR


def test_what_was_not_measured_has_none() -> None:
    found = residuals([[1.0, 2.0]], [[np.nan, 4.0]], [1.0, 2.0], [False, True])
    assert np.isnan(found[0, 0])
    assert found[0, 1] == pytest.approx(np.log(0.5) / 2.0)


def test_deviations_are_of_logarithms_where_residuals_are(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("residuals") / "growth.gb"
    path.write_text(TEXT)
    model = driver.load_model(path, Findings())
    data = driver.simulate(driver.reference(model), SimulateOptions(trajectories=3, span=4.0, keep_start=True))
    values = np.concatenate([item.values for item in data.items])
    assert logarithmic(model).tolist() == [True, False]
    np.testing.assert_allclose(deviations(model, data), [np.log(values[:, 0]).std(), values[:, 1].std()])
