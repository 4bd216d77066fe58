"""Learned, bred and true initial states, and their differences along fast and slow directions."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gbspec.analysis.prediction.start_comparison import InitialStates, _modes, initial_states
from gbspec.analysis.simulation.simulate import simulate
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.data.sampling import SimulateOptions
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import UserError
from gbspec.operations import analysing, models
from gbspec.report.files import result as draw
from gbspec.runs.record import DataRecord
from tests.analysis.conftest import model_of, nearly_true

OPTIONS = SimulateOptions(trajectories=2, span=3.0, sampling="gamma", channels="own-clock", seed=2,
                          initial={"x1": (0.3, 0.7), "x2": (0.5, 2.0)}, reject=("x2 > 4",))  # fmt: skip
OFF = 0.05


@pytest.fixture(scope="module")
def data() -> Trajectories:
    subject = models.reference(model_of("urp_gb2"))
    return replace(simulate(subject.evaluator, subject.model, OPTIONS), sha256="known")


@pytest.fixture(scope="module")
def found(data: Trajectories) -> InitialStates:
    """Initial states for a nearly true network; the learned ones differ from the true ones by `OFF` in x1."""
    model, instance = model_of("urp_gb2"), nearly_true()
    subject = models.reference(model)
    instance.weights["initial"] = np.tile([0.5, 1.0], (len(data), 1))
    starts = [item.true for item in compare(instance, data, subject.evaluator).items if item.true is not None]
    instance.weights["initial"] = np.add(starts, [OFF, 0.0])
    return compare(instance, data, subject.evaluator)


def compare(instance: Any, data: Trajectories, truth: Any) -> InitialStates:
    model, evaluator = model_of("urp_gb2"), Evaluator(instance)
    system = analysing.system(models.Subject(model, evaluator))
    return initial_states(evaluator, model, data, DataRecord("", "known", 4, 0, 0), system, truth)


@pytest.mark.filterwarnings("error::RuntimeWarning")  # some guesses have diverging solutions
def test_bred_initial_states_are_closer_to_the_truth_than_wrong_ones(found: InitialStates, data: Trajectories) -> None:
    assert [item.trajectory for item in found.items] == [item.label for item in data.items]
    for item in found.items:
        assert item.true is not None
        assert item.bred_off is not None
        assert item.learned - item.true == pytest.approx([OFF, 0.0], abs=1e-12)
        assert abs(item.bred[0] - item.true[0]) < 0.3 * OFF
        assert np.max(item.bred_off) < 0.3 * np.max(item.learned_off)


def test_they_print_write_and_draw_themselves(found: InitialStates) -> None:
    text = str(found)
    assert all(word in text for word in ("learned", "bred", "true", "mode 2 (real part"))
    assert all(" bred " in line for line in text.splitlines() if line.startswith("  mode"))
    document = json.loads(json.dumps(found.to_json()))
    assert set(document["initial_states"][0]["bred"]) == {"x1", "x2"}
    made = draw(found)
    said = [axes.get_ylabel().replace("\n", " ") for axes in made.axes]  # long ones are broken
    assert said == ["x1", "x2", *["distance from the true initial state"] * 2]


def test_a_difference_along_one_direction_is_only_in_its_mode() -> None:
    slow, fast = np.array([1.0, 0.5]), np.array([-0.2, 1.0])
    frame = np.column_stack([slow, fast])
    jacobian = frame @ np.diag([-0.1, -40.0]) @ np.linalg.inv(frame)
    scale = np.array([2.0, 5.0])
    eigenvalues, split = _modes(jacobian, scale)
    assert eigenvalues.real == pytest.approx([-0.1, -40.0])
    assert split(0.3 * slow) == pytest.approx([0.3 * np.linalg.norm(slow / scale), 0.0], abs=1e-12)
    assert split(0.3 * fast) == pytest.approx([0.0, 0.3 * np.linalg.norm(fast / scale)], abs=1e-12)


def test_both_modes_of_a_pair_have_the_common_component() -> None:
    _, split = _modes(np.array([[-1.0, 3.0], [-3.0, -1.0]]), np.ones(2))
    assert split(np.array([3.0, 4.0])) == pytest.approx([5.0, 5.0])


def test_trajectories_that_were_not_trained_on(data: Trajectories) -> None:
    instance = nearly_true()
    instance.weights["initial"] = np.zeros((9, 2))
    with pytest.raises(UserError) as caught:
        compare(instance, data, None)
    assert caught.value.diagnostics[0].code == "GB876"


@pytest.mark.parametrize("moved", [0.0, 0.01])
def test_measured_initial_states_are_compared_where_a_fit_has_moved_them(moved: float) -> None:
    """Fits of whole solutions treat first values as measurements like all others, and learn where solutions begin."""
    subject = models.reference(model_of("urp_gb2"))
    options = replace(OPTIONS, channels="all", keep_start=True)
    full = replace(simulate(subject.evaluator, subject.model, options), sha256="known")
    instance = nearly_true()
    instance.weights["initial"] = np.array([item.values[0] + moved for item in full.items])
    if moved:
        learned = [item.learned for item in compare(instance, full, None).items]
        np.testing.assert_array_equal(learned, instance.weights["initial"])
        return
    with pytest.raises(UserError) as caught:
        compare(instance, full, None)
    assert "the model or the table gives them" in caught.value.diagnostics[0].message
