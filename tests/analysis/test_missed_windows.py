"""Starts that were estimated from rows which the solution does not follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gbspec.analysis.prediction.followed import missed, said_of_starts
from gbspec.analysis.prediction.forecast import forecast
from gbspec.analysis.validation.validate import validate
from gbspec.arrays import Array
from gbspec.data import Limits, Trajectories, Trajectory
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

TIMES = np.linspace(0, 6, 25)
WORDS = "not follow the rows from which what is unknown was estimated"


def decay(label: str, wrong: float = 0.0, seed: int = 0) -> Trajectory:
    """Noise of 0.2 around a decay, and a wave that no start of the model leads along."""
    noise = 0.2 * np.random.default_rng(seed).standard_normal(len(TIMES))
    values = 10 * np.exp(-0.3 * TIMES) + wrong * np.sin(3 * TIMES) + noise
    return trajectory(label, 0.0, TIMES, values[:, None], [])


def table(*items: Trajectory) -> Trajectories:
    return Trajectories(items, ("x",))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    model = model_of(
        "model decay\ntime t from 0\nstate x in [0, 20]\ninitial x learn\nlearn k = 0.2 in [0.05, 5]\nx' = -k*x\n"
        "observe x\n"
    )
    return train(model, table(decay("a"), decay("b", seed=1)), TrainOptions(effort="low"),
                 tmp_path_factory.mktemp("missed") / "run")  # fmt: skip


def said(warnings: tuple[str, ...]) -> list[str]:
    return [warning for warning in warnings if WORDS in warning]


def test_predict_and_validate_name_what_is_followed_badly(run: Run) -> None:
    data = table(decay("good", seed=2), decay("bad", 2.0, 3))
    (warning,) = said(forecast(run, data, window=20).warnings)
    assert "the solution of trajectory `bad` does" in warning and "`good`" not in warning
    assert (
        "rmse of `x` 1." in warning and "in 20 values" in warning and "`--window`" in warning and "initial" in warning
    )
    assert "the fit has 0.2" in warning or "the fit has 0.1" in warning
    assert f"the fit has {run.fit.members[0].rmse['x']:.4g} in its training data" in warning, "not the noise"
    (warning,) = said(validate(run, data, truth=False).warnings)
    assert "`bad`" in warning and "`good`" not in warning and "in 25 values" in warning


def test_several_are_one_warning_with_the_worst_first(run: Run) -> None:
    data = table(decay("bad", 2.0, 3), decay("worse", 4.0, 3))
    (warning,) = said(forecast(run, data, window=20).warnings)
    assert "trajectories `worse`, `bad` do" in warning and "`worse`: rmse" in warning


def test_what_is_followed_or_not_estimated_has_no_warning(run: Run) -> None:
    other = table(decay("good", seed=2), decay("longer", seed=7))
    assert not said(forecast(run, other).warnings) and not said(validate(run, other, truth=False).warnings)
    assert not said(validate(run, table(decay("a"), decay("b", seed=1)), truth=False).warnings)
    assert not said(forecast(run, table(decay("bad", 2.0, 3)), window=9).warnings), "nine values are too few"


def test_stated_deviations_limits_and_small_residuals_count(run: Run) -> None:
    scales = run.fit.scales_for(run.model, table(decay("a")))

    def of(item: Trajectory, channels: Array) -> bool:
        return missed(run.model, run.fit, scales, item, channels) is not None

    item, away = decay("a"), decay("a").values + 1.5
    assert of(item, away)
    assert not of(replace(item, sd=np.full((25, 1), 2.0)), away)
    assert not of(replace(item, limits=Limits(item.values, np.ones((25, 1), dtype=np.int8))), away)
    exact = replace(run.fit, noise={"x": 1e-6}, members=tuple(replace(m, rmse={"x": 1e-6}) for m in run.fit.members))
    assert missed(run.model, exact, scales, item, item.values + 1e-4) is None
    blown = replace(run.fit, members=tuple(replace(m, rmse={"x": None}) for m in run.fit.members))
    assert missed(run.model, blown, scales, item, away) is None, "the fit does not follow its own data"
    assert said_of_starts([None], "") == []
