from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy

from gbspec.analysis import extrapolation_of, system_of
from gbspec.analysis.prediction.estimate import Estimator
from gbspec.analysis.prediction.solutions import learned_positions, learned_start, predict
from gbspec.analysis.simulation.simulate import simulate
from gbspec.analysis.validation.comparison_points import sampling_for
from gbspec.analysis.validation.limits import LimitsKept
from gbspec.analysis.validation.step_check import StepCheck, step_check
from gbspec.analysis.validation.truth_errors import has_reference, truth_errors, truth_model, without_truth
from gbspec.analysis.validation.validate import TrajectoryError, _data_warnings, bundled_case, validate
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.data.cases import MetricsOptions
from gbspec.data.fingerprints import fingerprint
from gbspec.data.sampling import SimulateOptions
from gbspec.data.scales import scales_of
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.operations.models import reference
from gbspec.runs import Certainties, Support, open_run
from gbspec.runs.record import DataRecord
from gbspec.runs.store import Run
from tests.analysis.conftest import model_of, nearly_true

FEW = MetricsOptions(settle=60.0, horizon=5.0, conditions=3, points=4, spacing=0.5, window=(5.0, 15.0), rhs_points=40)


def measured(name: str, **options: Any) -> Trajectories:
    """Simulated measurements of a bundled model's truth, sampled as in its case."""
    subject = reference(model_of(name))
    case = bundled_case(model_of(name))
    assert case is not None
    return simulate(subject.evaluator, subject.model, replace(case.sampling, **options))


@pytest.fixture(scope="module")
def urp_data() -> Trajectories:
    return measured("urp_gb2", trajectories=4, span=6.0)


# ---------------------------------------------------------------------- the worst row, and where functions extrapolate
def test_a_headline_is_followed_by_its_worst_row(
    urp_instance: Any, urp_data: Trajectories, write_run: Callable[..., Run]
) -> None:
    items = list(urp_data.items)
    values = items[2].values.copy()
    row = int(np.flatnonzero(np.isfinite(values[:, 1]))[3])
    values[row, 1] += 40.0
    items[2] = replace(items[2], values=values)
    found = validate(write_run(model_of("urp_gb2"), urp_instance), replace(urp_data, items=tuple(items)), truth=False)
    assert found.worst is not None and not found.empty
    assert (found.worst.trajectory, found.worst.time, found.worst.channel) == (
        items[2].label,
        items[2].times[row],
        "x2",
    )
    assert found.worst.measured - found.worst.predicted == pytest.approx(40.0, abs=1.0)
    assert f"worst row: x2 of trajectory `{items[2].label}`" in str(found)


def test_rows_far_from_the_training_data_are_told(
    urp_instance: Any, urp_data: Trajectories, write_run: Callable[..., Run]
) -> None:
    run = write_run(model_of("urp_gb2"), urp_instance)
    before = validate(run, urp_data, truth=False)
    assert not any(one.extrapolated for one in before.trajectories), "not known"
    states = before.predictions[0].states
    points = np.column_stack([states, np.full(len(states), float(urp_data.items[0].condition[0]))])
    Certainties(None, {"phi": Support(points, np.zeros(len(points)))}).write(run.path / "members" / "0")
    found = validate(open_run(run.path), urp_data, truth=False)
    assert not found.trajectories[0].extrapolated
    assert any(one.extrapolated.get("phi", 0) > 0 for one in found.trajectories[1:])
    assert any("`phi` is extrapolated, far from its training data" in warning for warning in found.warnings)
    point = np.array([0.5, 30.0])
    known = extrapolation_of(open_run(run.path))
    system = system_of(Evaluator(urp_instance), model_of("urp_gb2"), known).with_values({"Da": points[0, 2]})
    assert system.outside(points[3, :2]) == ()
    assert system.outside(point) == ("x2", "phi")
    assert system.outside(np.stack([points[3, :2], point])) == ("x2", "phi")


def test_what_is_told_has_the_right_number() -> None:
    def said(*counts: dict[str, int]) -> list[str]:
        errors = [TrajectoryError(str(i), 0.1, "estimated", "", each) for i, each in enumerate(counts)]
        return _data_warnings(errors, model_of("urp_gb2"))

    far, estimated = said({"f": 1})
    assert far == "`f` is extrapolated, far from its training data, in 1 row (`0`)"
    assert estimated.startswith("the initial states of 1 trajectory that training did not see (`0`) were estimated")
    far, estimated = said({"f": 1, "g": 2}, {"f": 3})
    assert far == "`f`, `g` are extrapolated, far from their training data, in 5 rows (`0`, `1`)"
    assert "of 2 trajectories that" in estimated
    kept = [str(LimitsKept(n, n - 1, 0.5)) for n in (1, 2)]
    assert "0 of 1 censored value is predicted on its side of the limit; the other by 0.5" in kept[0]
    assert "1 of 2 censored values are predicted on their side of the limit; the other by" in kept[1]


# ---------------------------------------------------------------------- against the truth
def test_a_near_fit_has_small_errors_of_the_right_size(urp_instance: Any) -> None:
    model = model_of("urp_gb2")
    case = bundled_case(model)
    assert case is not None
    found = truth_errors(model, [Evaluator(urp_instance)], case.sampling, FEW)
    assert 1e-5 < found.functions["phi"].L2 < 1e-2
    assert found.functions["all"] == found.functions["phi"]
    assert 1e-5 < found.solution.L2 < 5e-2
    assert (found.solution.points, found.rhs.points) == (12, 40)
    assert found.constants == {"all": 0.0, "B": 0.0, "beta": 0.0}


def test_functions_are_also_compared_at_the_arguments_of_the_training(urp_instance: Any) -> None:
    """A transient has been where the drawn points, at rest, are not."""
    model = model_of("urp_gb2")
    case = bundled_case(model)
    assert case is not None
    points = np.random.default_rng(0).uniform([0.1, 0.5, 0.2], [0.6, 2.5, 0.4], (30, 3))
    support = {model.networks[0].name: Support(points, np.zeros(30, dtype=np.int64))}
    found = truth_errors(model, [Evaluator(urp_instance)], case.sampling, FEW, support)
    assert found.on_data["phi"].points == 30
    assert 0 < found.on_data["phi"].L2 != found.functions["phi"].L2
    assert "phi, training data" in str(found)
    assert found.to_json()["functions_on_data"]


def test_the_error_of_the_function_is_that_of_the_network(urp_instance: Any) -> None:
    # With the constants right, the right-hand side's errors are those of phi: once in x1, 11 times in x2.
    model = model_of("urp_gb2")
    case = bundled_case(model)
    assert case is not None
    evaluator = Evaluator(urp_instance)
    found = truth_errors(model, [evaluator], case.sampling, FEW)
    assert found.rhs.L1 < 4 * found.functions["phi"].L1


def test_wrong_constants_are_measured() -> None:
    model = model_of("urp_gb2")
    case = bundled_case(model)
    assert case is not None
    instance = nearly_true({"B": 12.1, "beta": 2.7})
    found = truth_errors(model, [Evaluator(instance)], case.sampling, FEW)
    assert found.constants == pytest.approx({"all": 0.1, "B": 0.1, "beta": 0.1})
    assert found.solution.L2 > 0.02


def test_a_mean_of_members_is_the_mean_of_their_predictions() -> None:
    model = model_of("urp_gb2")
    case = bundled_case(model)
    assert case is not None
    pair = [Evaluator(nearly_true({"B": B})) for B in (10.0, 12.0)]
    both, one = (truth_errors(model, members, case.sampling, FEW) for members in (pair, pair[:1]))
    assert both.constants["B"] == pytest.approx(0.0, abs=1e-12)
    assert both.rhs.L2 < 0.2 * one.rhs.L2


def test_the_same_points_are_drawn_again() -> None:
    model = model_of("urp_gb2")
    case = bundled_case(model)
    assert case is not None
    few = replace(FEW, rhs_points=10, conditions=2, points=2)
    evaluator = Evaluator(nearly_true())
    first, second = (truth_errors(model, [evaluator], case.sampling, few) for _ in range(2))
    assert first == second


def test_several_unknowns_and_fallback_scales() -> None:
    model = model_of("bf_gb1")
    case = bundled_case(model)
    assert case is not None
    instance = load_module(model).random(3)
    few = replace(case.metrics, points=5, rhs_points=12)
    found = truth_errors(model, [Evaluator(instance)], case.sampling, few)
    assert set(found.functions) == {"all", "r1", "r2", "r3"}
    # The first commensal is washed out on the cycle: its solution does not vary, and the case's scale is used.
    assert found.solution.fallback == ("y",)
    assert found.constants == {}


def test_a_function_applied_to_each_element_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of("spreading_population")
    case = bundled_case(model)
    assert case is not None
    compiled: list[Any] = []
    own = sympy.lambdify
    monkeypatch.setattr(sympy, "lambdify", lambda *given, **named: compiled.append(given) or own(*given, **named))  # type: ignore[func-returns-value]
    few = replace(case.metrics, conditions=2, points=2, rhs_points=3)
    found = truth_errors(model, [Evaluator(load_module(model).random(0))], case.sampling, few)
    assert found.functions["g"].points == 3 * len(model.states)
    assert len(compiled) == 2, "all arguments in one call, and the function's truth"


def test_a_driven_model_is_compared_along_its_trajectories() -> None:
    model = model_of("friction_oscillator")
    case = bundled_case(model)
    assert case is not None
    few = MetricsOptions(conditions=2, points=3, rhs_points=8)
    found = truth_errors(model, [Evaluator(load_module(model).random(0))], case.sampling, few)
    assert found.solution.points + found.solution.failed == 6
    assert found.rhs.points == 8


def test_undeclared_boxes_of_initial_states_come_from_the_weights() -> None:
    model = model_of("urp_gb2")
    model = replace(model, states=(model.states[0], replace(model.states[1], range=None)))
    instance = nearly_true()
    instance.weights["initial"] = np.array([[0.3, 0.5], [0.5, 2.5]])
    found = sampling_for(model, SimulateOptions(), instance)
    assert found.initial == {"x2": (0.5, 2.5)}


# ---------------------------------------------------------------------- on data
REACTOR = """model reactor
state x1 in [0, 1]
state x2 = 1
condition Da in [0.2, 0.5]
x1' = -x1 + Da*(1 - x1)*exp(x2)
x2' = -x2 + 11*Da*(1 - x1)*exp(x2) - 3*x2
observe x1
observe x2
"""


def test_the_truth_itself_has_no_errors_on_its_own_data(
    write_run: Callable[..., Run], urp_data: Trajectories, tmp_path: Path
) -> None:
    path = tmp_path / "reactor.gb"
    path.write_text(REACTOR, encoding="utf-8")
    model = load_model(path, Findings())
    run = write_run(model, load_module(model)(None, {"max_step": 0.1}))
    found = validate(run, urp_data, truth=False)
    for errors in found.channels.values():
        assert errors.nrmse < 1e-3
        assert errors.r2 > 1 - 1e-6
    assert {one.initial for one in found.trajectories} == {"estimated"}
    assert any("estimated" in warning for warning in found.warnings)


def test_json_has_the_keys_of_the_contract(
    write_run: Callable[..., Run], urp_instance: Any, urp_data: Trajectories
) -> None:
    run = write_run(model_of("urp_gb2"), urp_instance)
    found = validate(run, urp_data, metrics=FEW)
    document = json.loads(json.dumps(found.to_json()))
    assert list(document)[:4] == ["channels", "trajectories", "step_check", "truth"]
    assert list(document["channels"]) == ["x1", "x2"]
    assert list(document["channels"]["x1"]) == ["n", "rmse", "nrmse", "mae", "r2"]
    assert list(document["trajectories"][0])[:2] == ["trajectory", "nrmse"]
    assert list(document["step_check"])[:2] == ["half_step", "adaptive"]
    assert list(document["truth"])[:4] == ["solution", "rhs", "functions", "constants"]
    assert list(document["truth"]["rhs"])[:3] == ["L1", "L2", "Linf"]
    assert next(iter(document["truth"]["constants"])) == "all"
    assert document["member"] == "mean"
    for name in ("x1", "half step", "right-hand side", "function phi"):
        assert name in str(found)
    assert found.truth is not None
    long = "concentration_of_the_product"
    truth = replace(found.truth, functions={long: found.truth.rhs})
    text = str(replace(found, channels={long: found.channels["x1"]}, truth=truth))
    assert f"function {long}  L1" in text
    assert f"\n{long}  " in text


def test_learned_initial_states_are_found_by_content(
    write_run: Callable[..., Run], urp_instance: Any, urp_data: Trajectories
) -> None:
    starts = np.array([[0.31, 1.1], [0.32, 1.2], [0.33, 1.3], [0.34, 1.4]])
    info = {**urp_instance.info, "fingerprints": [fingerprint(item) for item in urp_data.items]}
    instance = type(urp_instance)({**urp_instance.weights, "initial": starts}, info)
    run = write_run(model_of("urp_gb2"), instance)
    shuffled = Trajectories((urp_data.items[2], urp_data.items[0]), urp_data.channels)
    found = validate(run, shuffled, truth=False)
    assert [one.initial for one in found.trajectories] == ["learned", "learned"]
    assert found.predictions[0].start.state.tolist() == [0.33, 1.3]
    assert found.predictions[1].start.state.tolist() == [0.31, 1.1]
    assert not any("estimated" in warning for warning in found.warnings)


def test_learned_initial_states_are_found_by_the_table_without_fingerprints(urp_data: Trajectories) -> None:
    instance = nearly_true()
    instance.weights["initial"] = np.zeros((4, 2))
    same = replace(urp_data, sha256="abc")
    assert learned_positions(instance, same, DataRecord("", "abc", 4, 0, 0)) == [0, 1, 2, 3]
    assert learned_positions(instance, same, DataRecord("", "other", 4, 0, 0)) == [None] * 4


def test_estimated_initial_states_recover_the_true_ones() -> None:
    data = measured("lotka_volterra", trajectories=3)
    model = truth_model(model_of("lotka_volterra"))
    # Half of the channels' values are dropped, the first rows among them.
    thin = []
    for item in data.items:
        values = item.values.copy()
        values[:2] = np.nan
        values[::2, 0] = np.nan
        thin.append(replace(item, values=values))
    estimator = Estimator(Evaluator(load_module(model)()), model, scales_of(model, data))
    for item, full in zip(thin, data.items, strict=True):
        start = estimator.start(item)
        assert start.origin == "estimated"
        assert start.state == pytest.approx(full.values[0], rel=1e-3)


def test_an_initial_state_is_fitted_to_logarithms_for_lognormal_noise(tmp_path: Path) -> None:
    text = "model decay\nstate x in [0, 2]\ninitial x learn\nx' = -x\nobserve y = 2*x noise lognormal(0.3)\n"
    (tmp_path / "decay.gb").write_text(text)
    model = load_model(tmp_path / "decay.gb", Findings())
    times = np.linspace(0.5, 4.0, 8)
    wrong = np.where(np.arange(8) % 2, 1.3, 0.6)
    values = (2.0 * 0.8 * np.exp(-times) * wrong)[:, None]
    item = Trajectory("1", 0.0, times, values, np.ones((8, 1)), np.full((8, 1), np.nan), np.zeros(0))
    scales = scales_of(model, Trajectories((item,), ("y",)))
    start = Estimator(Evaluator(load_module(model)()), model, scales).start(item)
    # Least squares of logarithms average all of them; those of values would be dominated by the first ones.
    assert start.state[0] == pytest.approx(0.8 * math.exp(np.log(wrong).mean()), rel=1e-3)


def test_a_measured_first_row_is_the_initial_state(urp_instance: Any) -> None:
    data = measured("urp_gb2", trajectories=2, span=4.0, channels="all", keep_start=True)
    estimator = Estimator(Evaluator(urp_instance), model_of("urp_gb2"), scales_of(model_of("urp_gb2"), data))
    for item in data.items:
        start = estimator.start(item)
        assert start.origin == "known"
        assert start.state.tolist() == item.values[0].tolist()


def test_a_trajectory_that_cannot_be_solved_is_named_and_excluded(
    write_run: Callable[..., Run], urp_data: Trajectories
) -> None:
    instance = nearly_true()
    starts = np.array([[0.4, 1.0], [0.4, 1.0], [0.4, 1.0], [0.4, math.nan]])
    info = {**instance.info, "fingerprints": [fingerprint(item) for item in urp_data.items]}
    run = write_run(model_of("urp_gb2"), type(instance)({**instance.weights, "initial": starts}, info))
    found = validate(run, urp_data, truth=False)
    label = urp_data.items[3].label
    assert found.failed == (label,)
    assert math.isnan(found.trajectories[3].nrmse)
    assert found.to_json()["trajectories"][3]["nrmse"] is None  # type: ignore[index]
    assert any(f"`{label}`" in warning and "excluded from all errors" in warning for warning in found.warnings)
    counted = sum(int(np.isfinite(item.values[:, 0]).sum()) for item in urp_data.items[:3])
    assert found.channels["x1"].n == counted


def test_without_data_or_truth_there_is_only_the_member(write_run: Callable[..., Run], urp_instance: Any) -> None:
    run = write_run(model_of("urp_gb2"), urp_instance)
    found = validate(run, None, member=0, truth=False)
    assert found.to_json() == {
        "channels": {},
        "trajectories": [],
        "step_check": {"half_step": None, "adaptive": None, "step": 0.1, "trajectories": 0, "unsolved": 0},
        "member": 0,
        "warnings": [],
    }


# ---------------------------------------------------------------------- the step
def test_a_truth_that_cannot_be_sampled_is_a_warning(
    write_run: Callable[..., Run], urp_instance: Any, urp_data: Trajectories
) -> None:
    run = write_run(model_of("urp_gb2"), urp_instance)
    everywhere = SimulateOptions(trajectories=2, span=1.0, dt=0.5, reject="x1 > -1")
    found = validate(run, urp_data, sampling=everywhere, metrics=FEW)
    assert found.truth is None
    assert found.channels
    assert any("not compared with its truth" in warning for warning in found.warnings)


def test_a_step_that_is_too_large_is_reported(urp_data: Trajectories) -> None:
    small, large = nearly_true(), nearly_true()
    large.info["max_step"] = 0.6
    checks = []
    for instance in (small, large):
        info = {**instance.info, "fingerprints": [fingerprint(item) for item in urp_data.items]}
        starts = np.tile([0.8, 1.0], (4, 1))
        instance = type(instance)({**instance.weights, "initial": starts}, info)
        evaluator, model = Evaluator(instance), model_of("urp_gb2")
        predictions = [
            predict(evaluator, model, item, learned_start(evaluator, i, item)) for i, item in enumerate(urp_data.items)
        ]
        checks.append(step_check(evaluator, model, instance.info["max_step"], urp_data.items, predictions))
    assert checks[0].half_step is not None
    assert checks[0].half_step < 2e-3
    assert checks[0].warning is None
    assert checks[1].adaptive is not None
    assert checks[1].adaptive > 0.01
    assert "depends on its training step of 0.6" in str(checks[1].warning)


def test_a_fixed_step_that_diverges_is_reported() -> None:
    check = StepCheck(math.inf, math.inf, 5.0, 3)
    assert "blow up" in str(check.warning)
    assert check.to_json()["half_step"] is None


def test_a_model_without_a_truth_is_not_compared_with_its_starting_values() -> None:
    assert not has_reference(model_of("gas_oil"))
    assert has_reference(model_of("urp_gb2"))
    model = model_of("urp_gb2")
    assert without_truth(replace(model, truth_constants=model.truth_constants[:1])) == ("beta",)
