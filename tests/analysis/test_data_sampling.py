"""Models without a case are compared with their truth over the time that their data cover."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import gbspec.data
from gbspec.analysis.validation.data_sampling import sampling_like
from gbspec.analysis.validation.truth_errors import truth_errors
from gbspec.analysis.validation.validate import bundled_case, validate
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.data.cases import MetricsOptions
from gbspec.data.sampling import SimulateOptions
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories, Trajectory
from gbspec.diagnostics import ComputationError, Findings
from gbspec.frontend import load_model
from gbspec.ir.model import Model
from gbspec.runs.store import Run
from tests.analysis.conftest import model_of

BATTERY = """model battery_pack
state T in [280, 330]
condition load
unknown loss(load) by mlp(4)
T' = loss(load) - (T - 300)/1200
truth loss(load) = 0.01*load
observe T
"""
DRIFT = """model drift
state x in [0, 2]
time t
unknown rate(t) by mlp(4)
x' = rate(t) - x/1000
truth rate(t) = 0.001*(1 + exp(-((t - 9000)/600)^2))
observe x
"""
DOSED = """model dosed
state A in [0, 2]
input F held
learn k = 0.001 in [0, 1]
dose A
A' = F - k*A
truth k = 0.002
observe A
"""


@pytest.fixture(autouse=True)
def _few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    few = partial(MetricsOptions, conditions=2, points=2, rhs_points=20)
    monkeypatch.setattr(gbspec.data, "MetricsOptions", few)


def made(tmp_path: Path, text: str) -> Model:
    path = tmp_path / "own.gb"
    path.write_text(text, encoding="utf-8")
    return load_model(path, Findings())


def trajectory(start: float, end: float, condition: float | None = None) -> Trajectory:
    times = np.linspace(start, end, 7)
    values = np.linspace(0.5, 1.0, 7)[:, None]
    given = np.zeros(0) if condition is None else np.array([condition])
    return Trajectory("1", start, times, values, np.ones((7, 1)), np.full((7, 1), np.nan), given)


def test_the_protocol_has_the_time_scale_of_the_data(tmp_path: Path, write_run: Callable[..., Run]) -> None:
    model = made(tmp_path, BATTERY)
    run = write_run(model, load_module(model).random(0))
    data = Trajectories((trajectory(0.0, 3600.0, 1.0), trajectory(0.0, 1800.0, 3.0)), ("T",))
    found = validate(run, data).truth
    assert found is not None
    assert found.protocol["horizon"] == 1800.0
    assert found.protocol["settle"] == 720.0
    assert (found.protocol["window_from"], found.protocol["window_to"]) == (720.0, 3600.0)
    assert found.functions["loss"].fallback == (), "the condition is drawn from the data's range"


def test_without_data_the_protocol_has_general_values(tmp_path: Path, write_run: Callable[..., Run]) -> None:
    model = made(tmp_path, BATTERY.replace("condition load", "condition load in [1, 3]"))
    found = validate(write_run(model, load_module(model).random(0))).truth
    assert found is not None and found.protocol["horizon"] == 5.0


def test_a_bundled_case_is_not_changed_by_data(write_run: Callable[..., Run], monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[SimulateOptions] = []

    def compared(
        model: Model, evaluators: object, sampling: SimulateOptions, metrics: MetricsOptions, support: object
    ) -> None:
        seen.append(sampling)
        raise ComputationError("not made here")

    monkeypatch.setattr("gbspec.analysis.validation.validate.truth_errors", compared)
    model = model_of("urp_gb2")
    times = np.array([0.0, 0.4])
    item = Trajectory("1", 0.0, times, np.ones((2, 2)), np.ones((2, 2)), np.full((2, 2), np.nan), np.array([0.3]))
    validate(write_run(model, load_module(model).random(0)), Trajectories((item,), ("x1", "x2")))
    case = bundled_case(model)
    assert case is not None and seen == [case.sampling]


def test_a_function_of_time_is_compared_at_the_times_of_the_data(tmp_path: Path, write_run: Callable[..., Run]) -> None:
    model = made(tmp_path, DRIFT)
    run = write_run(model, load_module(model).random(0))
    found = validate(run, Trajectories((trajectory(8000.0, 10000.0),), ("x",))).truth
    assert found is not None
    assert found.protocol["horizon"] == 1000.0
    assert found.functions["rate"].fallback == (), "it varies at these times only"


def test_a_function_that_hardly_varies_is_compared_relative_to_its_magnitude(tmp_path: Path) -> None:
    model = made(tmp_path, DRIFT)
    few = MetricsOptions(conditions=2, points=2, rhs_points=20)
    evaluator = Evaluator(load_module(model).random(0))
    found = truth_errors(model, [evaluator], SimulateOptions(), few)
    assert found.functions["rate"].fallback == ("rate",)
    shown = np.mean([abs(evaluator.functions_many("rate", np.array([[t]]))[0] - 0.001) for t in (2.0, 6.0, 10.0)])
    assert pytest.approx(float(shown) / 0.001, rel=0.2) == found.functions["rate"].L1


def test_inputs_and_doses_are_drawn_like_those_of_the_data(tmp_path: Path, write_run: Callable[..., Run]) -> None:
    model = made(tmp_path, DOSED)
    given = [
        replace(
            trajectory(0.0, 3600.0),
            inputs=(Signal(np.array([0.0, 100.0]), np.array([0.0, level])),),
            doses=(DoseEvents(np.array(times), np.array(amounts)),),
        )
        for level, times, amounts in ((2.0, [600.0], [5.0]), (4.0, [0.0, 900.0], [1.0, 2.0]))
    ]
    found = sampling_like(model, Trajectories(tuple(given), ("A",)))
    assert (found.span, found.dt) == (3600.0, 180.0)
    assert found.condition == {"F": (0.0, 4.0)}
    assert found.dose == {"A": "1.0:5.0@0.0,900.0"}
    assert sampling_like(model, Trajectories((), ("A",))) == sampling_like(model, None) == SimulateOptions()
    compared = validate(write_run(model, load_module(model).random(0)), Trajectories(tuple(given), ("A",))).truth
    assert compared is not None and compared.protocol["horizon"] == 1800.0
    assert compared.rhs.points == 20 and compared.rhs.fallback == ()
