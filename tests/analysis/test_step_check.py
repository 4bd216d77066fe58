"""Every fit is checked for dependence on its step, and warns of it; tested with steps as long as a fast decay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis.prediction.solutions import Start, predict
from gbspec.analysis.validation.step_check import StepCheck, step_check, warning_of_other_data
from gbspec.analysis.validation.validate import validate
from gbspec.backends import Evaluator, load_module
from gbspec.data.trajectories import Signal, Trajectories
from gbspec.diagnostics import Findings
from gbspec.operations import fitting, tables
from gbspec.runs import StepRecord, open_run
from gbspec.training import TrainOptions
from gbspec.training.runs.variations import Point
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = """model decay
state x in [0, 2] = 1
unknown lost(x) by mlp(6)
x' = -lost
observe x
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Trajectories:
    path = tmp_path_factory.mktemp("decay") / "decay.csv"
    rows = [(k, t, float((1 + 0.1 * k) * np.exp(-2.4 * t))) for k in range(8) for t in (0.0, 1.0, 2.0, 3.0)]
    path.write_text("trajectory,t,x\n" + "".join(f"{k},{t},{x!r}\n" for k, t, x in rows))
    return tables.read_data(str(path), model_of(DECAY), Findings())


def options(step: float) -> TrainOptions:
    return TrainOptions(max_step=step, members=2, workers=1, method="lm", epochs=20, warm_start=False)


def test_a_fit_that_depends_on_its_step_has_a_warning(data: Trajectories, tmp_path: Path) -> None:
    run = fitting.train(model_of(DECAY), data, tmp_path / "run", options(1.0))
    assert [check.half_step > 0.01 for check in run.fit.step_checks] == [True, True]
    assert [check.trajectories for check in run.fit.step_checks] == [8, 8]
    told = [warning for warning in run.fit.warnings if "depends on its training step of 1" in warning]
    assert [warning.partition(":")[0] for warning in told] == ["member 0", "member 1"]
    assert all("Train with a smaller `--max-step`" in warning for warning in told)
    assert open_run(tmp_path / "run").fit == run.fit
    found = validate(run, data, truth=False)
    assert found.step_check.half_step == pytest.approx(run.fit.step_checks[0].half_step)
    assert found.warnings_after(run.fit.warnings) == list(run.fit.warnings)  # the warning is not repeated


def test_a_fit_that_is_independent_of_the_step_has_no_warning(data: Trajectories, tmp_path: Path) -> None:
    run = fitting.train(model_of(DECAY), data, tmp_path / "run", options(0.1))
    assert all(0 <= getattr(check, name) < 0.01 for check in run.fit.step_checks for name in ("half_step", "adaptive"))
    assert not any("depends on its training step" in warning for warning in run.fit.warnings)


def test_solutions_that_only_the_fixed_step_can_solve_are_reported(tmp_path: Path) -> None:
    model = model_of("model blow\nstate x in [0, 1000] = 1\nlearn k = 0.5 in [0.01, 3]\nx' = k*x^2\nobserve x\n")
    rows = []
    for start in (1.0, 1.1):
        rows += [(start, 0.0, start)]
        for t in (1.0, 2.0):  # a classical Runge-Kutta step of length 1 with k = 0.75 passes the singularity
            x = rows[-1][2]
            k1 = 0.75 * x**2
            k2 = 0.75 * (x + k1 / 2) ** 2
            k3 = 0.75 * (x + k2 / 2) ** 2
            rows += [(start, t, x + (k1 + 2 * k2 + 2 * k3 + 0.75 * (x + k3) ** 2) / 6)]
    (tmp_path / "blow.csv").write_text("trajectory,t,x\n" + "".join(f"{a},{t},{x!r}\n" for a, t, x in rows))
    found = Findings()
    data = tables.read_data(str(tmp_path / "blow.csv"), model, found)
    run = fitting.train(model, data, tmp_path / "run", TrainOptions(effort="low", max_step=1.0, workers=1))
    assert run.fit.step_checks[0].unsolved == 2
    assert any("2 of 2 trajectories" in w and "but not by an adaptive solver" in w for w in run.fit.warnings)


def test_a_failure_of_the_adaptive_solver_is_not_attributed_to_the_step() -> None:
    told = str(StepCheck(2e-8, 0.054, 0.1, 8).warning)
    assert "differs by up to 5.4 %" in told and "depends on its training step" not in told
    assert StepCheck(2e-8, 0.009, 0.1, 8).warning is None
    told = str(StepCheck(2e-8, None, 0.1, 0, 3).warning)
    assert "cannot solve 3 of 3 trajectories" in told and "the step is not the reason" in told
    assert StepCheck(2e-3, 0.054, 0.1, 8).warning is not None


def test_half_of_a_sub_step_is_shorter_than_the_changes_of_an_input() -> None:
    text = "model fed\nstate x in [0, 2] = 1\ninput F held\nx' = F - 9*x\nobserve x\n"
    times = np.linspace(0.0, 3.0, 11)
    signal = Signal(times, 1.0 + (np.arange(11) % 2))
    item = trajectory("1", 0.0, times, np.ones((11, 1)), [], inputs=(signal,))
    evaluator = Evaluator(load_module(model_of(text))())
    start = Start(np.array([1.0]), evaluator.constants, "known")
    predicted = predict(evaluator, model_of(text), item, start)
    found = step_check(evaluator, model_of(text), 1.0, [item], [predicted])  # inputs change three times in a step
    assert found.adaptive is not None and found.adaptive > 0.1
    assert found.half_step == pytest.approx(found.adaptive, rel=0.2)
    assert "depends on its training step" in str(found.warning)


def test_the_remainder_of_a_single_trajectory_is_recognised(data: Trajectories, tmp_path: Path) -> None:
    one = data.subset([3])
    fit = fitting.train(model_of(DECAY), one, tmp_path / "run", replace(options(1.0), holdout=0.3)).fit
    assert [check.trajectories for check in fit.step_checks] == [1, 1]


def test_each_run_of_a_sweep_is_checked(data: Trajectories, tmp_path: Path) -> None:
    said: list[str] = []

    class Heard:
        def update(self, update: object) -> None: ...

        def message(self, text: str) -> None:
            said.append(text)

    points = [Point("long", {}, options(1.0)), Point("short", {}, options(0.1))]
    fitting.sweep(model_of(DECAY), data, points, tmp_path, TrainOptions(effort="low", workers=1), Heard())
    assert len(open_run(tmp_path / "short").fit.step_checks) == 2
    assert [text.partition(":")[0] for text in said if "depends on its training step" in text] == ["long", "long"]


def test_a_sweep_of_a_model_with_a_constant_called_run(data: Trajectories, tmp_path: Path) -> None:
    model = model_of(DECAY.replace("-lost", "-run*lost").replace("unknown", "learn run = 1 in [0.1, 3]\nunknown"))
    points = [Point("one", {}, replace(options(0.1), members=1))]
    fitting.sweep(model, data, points, tmp_path, TrainOptions(effort="low", workers=1))
    assert len(open_run(tmp_path / "one").fit.step_checks) == 1


def test_other_data_that_are_faster_are_named_and_the_fit_is_not_blamed() -> None:
    good, bad = StepRecord(1e-3, 1e-3, 0.1, 5), StepRecord(0.2, 0.2, 0.1, 5)
    check = StepCheck(0.3, 0.3, 0.1, 4, 0, "test2")
    said = warning_of_other_data(check, good)
    assert said is not None and "30 % of the states' ranges in `test2`" in said and "learned right-hand" not in said
    for fitted in (bad, None):
        assert warning_of_other_data(check, fitted) == check.warning
    assert warning_of_other_data(StepCheck(1e-3, 1e-3, 0.1, 4), good) is None
