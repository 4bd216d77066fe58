"""Refits of initial states minimise the residuals of training: the same scales, weights and logarithms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gbspec.analysis.prediction import estimate
from gbspec.analysis.prediction.displaced import Displaced, variance_of
from gbspec.analysis.prediction.estimate import Estimator, predictions
from gbspec.analysis.prediction.forecast import forecast
from gbspec.analysis.prediction.solutions import Start, predict
from gbspec.analysis.prediction.start_comparison import initial_states
from gbspec.analysis.systems.system import system_of
from gbspec.arrays import Array
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.data.fingerprints import fingerprint
from gbspec.data.scales import scales_of
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.ir.model import Model
from gbspec.report import collect
from gbspec.runs import Covariance, spread_of_next
from gbspec.runs.store import Run, open_run
from gbspec.training import TrainOptions, train
from gbspec.training.problem.forcing import teacher_forcing
from gbspec.training.problem.packing import pack
from gbspec.training.problem.problem import Problem
from gbspec.training.problem.residuals import residuals_of
from gbspec.training.problem.scaling import scaling_of
from tests.training.conftest import model_of
from tests.training.conftest import trajectory as made

pytestmark = pytest.mark.usefixtures("quick_fits")

TEXT = """model pair
state x in [0, 5]
const k = 0.5
initial x learn
x' = -k*x
observe y1 = x{first}
observe y2 = 3*x{second}
"""
TIMES = np.linspace(0.5, 4.0, 8)


def pair(first: str = "", second: str = "") -> Model:
    """Two channels of one state that decays at the rate 0.5, with these noises."""
    return model_of(TEXT.format(first=first, second=second))


def with_unknown(first: str = "", second: str = "") -> Model:
    """The same with an unknown function, so that no channels share a scale."""
    text = TEXT.replace("x' = -k*x", "unknown f(x) by mlp(2)\nx' = -k*x + 0*f")
    return model_of(text.format(first=first, second=second))


def trajectory(label: str, start: float, sd: bool, several: bool) -> Trajectory:
    """Measurements that no solution meets: the first channel asks for a higher start, the second for a lower one."""
    x = start * np.exp(-0.5 * TIMES)
    rows = np.arange(len(TIMES))
    values = np.stack([1.2 * x, 3 * 0.7 * x * np.where(rows % 2, 1.1, 0.9)], axis=1)
    values[2, 0] = np.nan
    counts = np.where(np.isfinite(values), np.stack([1 + 3 * (rows % 3), 1 + rows % 2], axis=1) if several else 1, 0)
    spread = np.stack([0.01 + 0.02 * rows, np.full(len(rows), np.nan)], axis=1) if sd else np.full(values.shape, np.nan)
    return Trajectory(label, 0.0, TIMES, values, counts.astype(float), spread, np.zeros(0))


def table(sd: bool = False, several: bool = False) -> Trajectories:
    items = tuple(trajectory(str(k), start, sd, several) for k, start in enumerate((1.0, 2.5)))
    return Trajectories(items, ("y1", "y2"))


def exact_and_noisy() -> Trajectories:
    """The first channel within 0.01 of a solution, the second within 0.5."""
    x, wave = np.exp(-0.5 * TIMES), np.array([1, -1, -1, 1, 1, -1, -1, 1])
    values = np.stack([x + 0.01 * wave, 3 * x + 0.5 * wave[::-1]], axis=1)
    item = Trajectory("1", 0.0, TIMES, values, np.ones((8, 2)), np.full((8, 2), np.nan), np.zeros(0))
    return Trajectories((item,), ("y1", "y2"))


CASES: dict[str, tuple[Model, Trajectories]] = {
    "no noise": (with_unknown(), table()),
    "unequal stated noise": (with_unknown(" noise normal(0.001)", " noise lognormal(0.3)"), table()),
    "one stated noise": (with_unknown(" noise normal(0.02)"), table()),
    "a column of standard deviations": (with_unknown(), table(sd=True)),
    "a column and a stated noise": (with_unknown("", " noise normal(0.1)"), table(sd=True)),
    "averages": (with_unknown(" noise normal(0.02)", " noise normal(0.5)"), table(several=True)),
    "averages with their standard deviations": (pair(), table(sd=True, several=True)),
    "a shared unit": (pair(), table()),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> tuple[Model, Trajectories]:
    return CASES[request.param]


def member(model: Model) -> Any:
    return load_module(model).random(0)


def problem_of(model: Model, data: Trajectories) -> Problem:
    packed = pack(data, model, 0.1)
    return Problem(model, member(model), packed, teacher_forcing(model, packed, 0.0), scaling_of(model, packed, data))


def in_training(problem: Problem, index: int, channels: Array) -> Array:
    """Training's residuals [R, C] of one trajectory with these predicted channels [R, C]."""
    rows = problem.packed.row_trajectory == index
    predicted = np.zeros(problem.packed.values.shape)
    predicted[rows] = channels
    return residuals_of(problem, predicted)[rows]


def estimator_of(model: Model, data: Trajectories) -> Estimator:
    return Estimator(Evaluator(member(model)), model, scales_of(model, data))


def test_a_refit_has_the_residuals_of_training(case: tuple[Model, Trajectories]) -> None:
    model, data = case
    problem, estimator = problem_of(model, data), estimator_of(model, data)
    for index, item in enumerate(data.items):
        solution = np.stack([np.exp(-0.5 * TIMES), 3 * np.exp(-0.5 * TIMES)], axis=1)
        expected = in_training(problem, index, solution)
        np.testing.assert_allclose(estimator.residuals(item, solution), expected, rtol=1e-14)
        assert (expected[2, 0], np.abs(expected[3]).min() > 0) == (0.0, True)
        window = replace(item, **{name: getattr(item, name)[:4] for name in ("times", "values", "counts", "sd")})
        np.testing.assert_allclose(estimator.residuals(window, solution[:4]), expected[:4], rtol=1e-14)


def test_the_estimated_start_minimises_the_sum_of_squares_of_training(case: tuple[Model, Trajectories]) -> None:
    model, data = case
    problem, found = problem_of(model, data), predictions(Evaluator(member(model)), model, data)
    for index, one in enumerate(found):
        assert one.start.origin == "estimated"

        def cost(start: float, index: int = index) -> float:
            x = start * np.exp(-0.5 * TIMES)
            return float(np.sum(in_training(problem, index, np.stack([x, 3 * x], axis=1)) ** 2))

        x0 = float(one.start.state[0])
        costs = [cost(x0 * factor) for factor in (0.99, 1.0, 1.01)]
        assert costs[1] < min(costs[0], costs[2])
        vertex = 0.5 * (costs[0] - costs[2]) / (costs[0] - 2 * costs[1] + costs[2])
        assert abs(vertex) < 0.05, "the minimum of the parabola is at the estimate, to 0.05 %"


def test_stated_noise_decides_between_channels_that_disagree() -> None:
    data = table()
    starts = {}
    for name, (first, second) in {"first": (0.001, 1.0), "second": (1.0, 0.001)}.items():
        model = with_unknown(f" noise normal({first})", f" noise normal({second})")
        starts[name] = [float(one.start.state[0]) for one in predictions(Evaluator(member(model)), model, data)]
    assert starts["first"] == pytest.approx([1.2, 3.0], rel=1e-3)
    assert starts["second"] == pytest.approx([0.7, 1.75], rel=0.05)


def test_an_exact_channel_does_not_make_a_solution_a_failure() -> None:
    # Residuals in units of a stated noise of 1e-9 are far beyond what stands for a solution that cannot be integrated.
    model, data = with_unknown(" noise normal(1e-9)", " noise normal(1)"), table()
    found = predictions(Evaluator(member(model)), model, data)
    assert [one.start.origin for one in found] == ["estimated", "estimated"]
    assert [float(one.start.state[0]) for one in found] == pytest.approx([1.2, 3.0], rel=1e-3)


def test_all_that_refit_take_the_scales_of_training(
    case: tuple[Model, Trajectories], write_run: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, data = case
    expected = scaling_of(model, pack(data, model, 0.1), data)
    run, evaluator = write_run(model, member(model)), Evaluator(member(model))
    evaluator.instance.weights["initial"] = np.ones((2, 1))
    used: list[Array] = []
    own = Estimator.__init__

    def recorded(self: Estimator, *given: Any, **named: Any) -> None:
        own(self, *given, **named)
        used.append(self.scales.channel)

    monkeypatch.setattr(estimate.Estimator, "__init__", recorded)
    predictions(evaluator, model, data)
    forecast(run, data)
    evaluator.instance.info["fingerprints"] = [fingerprint(item) for item in data.items]
    initial_states(evaluator, model, data, None, system_of(evaluator, model))
    collect.Fitted(run, data).start(0, 0)
    assert len(used) == 4
    for scale in used:
        np.testing.assert_allclose(scale, expected.channel, rtol=1e-14)


def test_a_report_shows_the_residuals_of_training(
    case: tuple[Model, Trajectories], write_run: Callable[..., Run]
) -> None:
    model, data = case
    fitted = collect.Fitted(write_run(model, member(model)), data)
    problem, shown = problem_of(model, data), collect.residuals(fitted)
    tables = [in_training(problem, k, fitted.solutions(k, item.times)[1][0]) for k, item in enumerate(data.items)]
    for j, channel in enumerate(shown):
        seen = [np.isfinite(item.values[:, j]) for item in data.items]
        expected = np.concatenate([one[rows, j] for one, rows in zip(tables, seen, strict=True)])
        assert sorted(channel.residual) == pytest.approx(sorted(expected), rel=1e-12)


def test_the_certainty_of_an_estimate_weighs_channels_by_their_noise(write_run: Callable[..., Run]) -> None:
    """The precise channel alone determines the start, so that a noisy one beside it hardly changes its variance."""
    data, widths = exact_and_noisy(), []
    written = write_run(with_unknown(), member(with_unknown()))
    for second in (0.5, 5.0):
        model = with_unknown(" noise normal(0.01)", f" noise normal({second})")
        run = replace(written, model=model, fit=replace(written.fit, noise={"y1": 0.01, "y2": second}))
        widths.append(float(forecast(run, data).items[0].sd[0, 0]))
    # The noise of a new measurement, and that of the start, which four of its values determine.
    assert widths[0] == pytest.approx(widths[1], rel=0.02)
    assert 0.01 < widths[0] < 0.02


def test_a_new_table_is_weighed_with_the_scales_of_the_training(tmp_path: Path) -> None:
    model = model_of("model m\nstate x in [0, 9]\nlearn k = 0.5 in [0, 5]\nx' = -k*x\nobserve x\nobserve y = 3*x\n")
    times = np.linspace(0, 4, 9)

    def table(start: float) -> Trajectories:
        values = start * np.exp(-times)[:, None] * [1.0, 3.0]
        return Trajectories((made("1", 0.0, times, values, []),), ("x", "y"))

    run = train(model, table(2.0), TrainOptions(effort="low", max_step=0.5), tmp_path / "run")
    again = open_run(run.path).fit
    trained, new = scales_of(model, table(2.0)), again.scales_for(model, table(0.1))
    np.testing.assert_allclose(new.channel, trained.channel)
    assert (new.level, new.noise, new.log.tolist()) == (trained.level, trained.noise, [False, False])
    older = replace(again, scales=None)
    np.testing.assert_allclose(older.scales_for(model, table(0.1)).channel, scales_of(model, table(0.1)).channel)
    assert "scales" not in older.to_json()


def test_the_uncertainty_of_the_model_is_that_of_its_linearisation() -> None:
    model = model_of("model m\nstate x\nlearn k = 0.5\nlearn c = 1\nx' = -k*x + 0*c\nobserve x\n")
    none = np.zeros((2, 0))
    known = Covariance((), ("k", "c"), 0.0, np.zeros((0, 0)), np.zeros(0), none, np.diag([0.04**2, 1.0]))
    evaluator = Evaluator(load_module(model)())
    item = made("1", 0.0, TIMES, np.full((len(TIMES), 1), np.nan), [])
    start = Start(np.array([2.0]), evaluator.constants, "known")

    def solve(one: Evaluator, at: Start) -> Array:
        return predict(one, model, item, at).channels

    exact = 0.04 * TIMES * 2.0 * np.exp(-0.5 * TIMES)
    here = solve(evaluator, start)
    found = np.sqrt(variance_of(here, Displaced(evaluator.instance, known).slopes(start, here, solve)))[:, 0]
    later = TIMES > 0
    ratio = found[later] / exact[later]
    assert np.ptp(ratio) < 0.05 and 0.6 < ratio.mean() < 1.4, "one number per draw, of 16"
    fixed = Displaced(evaluator.instance, known, frozenset({"k"}))
    np.testing.assert_allclose(variance_of(here, fixed.slopes(start, here, solve)), 0.0, atol=1e-12)


@pytest.mark.parametrize("count", [2, 3, 5, 20])
def test_the_spread_of_a_new_trajectory_is_that_of_one_more_of_few(count: int) -> None:
    """90 % of the next values lie inside the interval that the ones before give, however few these are."""
    values = np.random.default_rng(count).standard_normal((count + 1, 20000))
    sd, mean = spread_of_next(values[:count]), values[:count].mean(axis=0)
    inside = np.abs(values[count] - mean) < 1.6448536 * sd
    assert inside.mean() == pytest.approx(0.9, abs=0.01)
    assert spread_of_next(values[:1]).max() == 0
