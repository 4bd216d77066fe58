from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from gbspec.analysis.bifurcation.eigen import eigen, format_eigenvalue
from gbspec.analysis.prediction.solutions import Prediction, Start
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.diagnostics import UserError
from tests.analysis.textbook import brusselator, textbook, urp


def test_eigenvalues_at_a_point_beside_the_truth() -> None:
    found = eigen(urp(), at=[{"x1": 0.4, "x2": 1.2, "Da": 0.3}], truth=urp(B=12.0))
    (point,) = found.points
    heat = 0.3 * np.exp(1.2)
    jacobian = np.array([[-1 - heat, heat * 0.6], [-11 * heat, -4 + 11 * heat * 0.6]])
    assert point.eigenvalues == pytest.approx(sorted(np.linalg.eigvals(jacobian), key=lambda v: (-v.real, -v.imag)))
    assert point.truth is not None
    assert point.rhs_norm == pytest.approx(np.hypot(-0.4 + heat * 0.6, -4 * 1.2 + 11 * heat * 0.6))


def test_the_truth_keeps_its_own_constants() -> None:
    # In these systems B counts as a condition; a truth's constants are its own, its conditions those of the point.
    (point,) = eigen(urp(), at=[{"x1": 0.4, "x2": 1.2, "Da": 0.3, "B": 9.0}], truth=urp()).points
    assert point.truth == pytest.approx(point.eigenvalues)


def test_json_has_the_keys_of_the_contract() -> None:
    document = json.loads(json.dumps(eigen(urp(), at=[{"x1": 0.4, "x2": 1.2, "Da": 0.3}]).to_json()))
    assert next(iter(document)) == "points"
    assert list(document["points"][0])[:5] == ["state", "condition", "rhs_norm", "eigenvalues", "truth"]
    assert document["points"][0]["truth"] is None
    assert document["points"][0]["state"] == {"x1": 0.4, "x2": 1.2}


def test_everything_wrong_with_a_point_is_reported_at_once() -> None:
    with pytest.raises(UserError) as caught:
        eigen(urp(), at=[{"x1": 0.4, "x3": 1.2}])
    assert [d.code for d in caught.value.diagnostics] == ["GB870", "GB871"]
    assert "`x2`" in caught.value.diagnostics[1].message
    assert "x2=..." in caught.value.diagnostics[1].help


def test_steady_states_across_the_range_of_the_open_condition() -> None:
    found = eigen(urp(), steady=True)
    assert [point.condition["Da"] for point in found.points] == pytest.approx([0.2, 0.275, 0.35, 0.425, 0.5])
    assert all(point.rhs_norm < 1e-10 and point.kind == "steady" for point in found.points)
    assert [bool(np.all(point.eigenvalues.real < 0)) for point in found.points] == [True, True, False, True, True]


def test_steady_states_at_a_given_condition() -> None:
    (point,) = eigen(brusselator(), at=[{"B": 2.5}], steady=True).points
    assert point.eigenvalues.real == pytest.approx([0.25, 0.25])


def trajectory(values: list[list[float]]) -> Trajectories:
    array = np.array(values)
    times = np.arange(len(values), dtype=float)
    counts = np.isfinite(array).astype(float)
    item = Trajectory("one", 0.0, times, array, counts, np.full(array.shape, np.nan), np.array([0.3, 11.0, 3.0]))
    return Trajectories((item,), ("x1", "x2"))


def test_along_data_takes_the_rows_that_measure_every_state() -> None:
    data = trajectory([[0.4, 1.2], [0.5, np.nan], [0.6, 1.4]])
    found = eigen(urp(), along=data)
    assert [(point.trajectory, point.time) for point in found.points] == [("one", 0.0), ("one", 2.0)]
    assert found.points[0].to_json()["kind"] == "data"


def test_along_a_table_without_a_state() -> None:
    with pytest.raises(UserError) as caught:
        eigen(brusselator(), along=trajectory([[0.4, 1.2]]))
    assert caught.value.diagnostics[0].code == "GB874"


def test_eigenvalues_print_as_people_write_them() -> None:
    assert format_eigenvalue(-0.5 + 0j) == "-0.5"
    assert format_eigenvalue(0.125 - 2.25j) == "0.125 - 2.25i"
    text = str(eigen(urp(), at=[{"x1": 0.4, "x2": 1.2, "Da": 0.3}]))
    assert "x1 = 0.4" in text
    assert "eigenvalues" in text


def test_rows_that_measure_too_little_take_the_predicted_states() -> None:
    data = trajectory([[0.4, 1.2], [0.5, np.nan], [0.6, 1.4]])
    item = data.items[0]
    states = np.array([[9.0, 9.0], [0.55, 1.3], [9.0, 9.0]])
    start = Start(states[0], np.zeros(0), "estimated")
    found = eigen(urp(), along=data, predicted=[Prediction("one", start, item.times, states, states)])
    assert [point.kind for point in found.points] == ["data", "predicted", "data"]
    assert [point.state["x1"] for point in found.points] == [0.4, 0.55, 0.6]


def test_modes_that_die_out_between_measurements_are_named() -> None:
    def rhs(x1: object, x2: object) -> tuple[object, ...]:
        return -0.1 * x1, -40.0 * x2  # type: ignore[operator]

    system = textbook("two_scales", ("x1", "x2"), rhs, {}, {})
    data = trajectory([[0.4, 1.2], [0.5, 1.0]])
    data = replace(data, items=(replace(data.items[0], condition=np.zeros(0)),))
    found = eigen(system, along=data)
    (mode,) = found.fast_modes
    assert (found.interval, mode.rank, mode.fastest) == (1.0, 1, pytest.approx(-40.0))
    assert mode.decayed == pytest.approx(3.0 / 40.0)
    assert mode.states == ("x2",)
    assert "mode 2, of x2 (real part" in str(found)
    assert "the data could not determine it" in str(found)
    assert found.to_json()["fast_modes"] == [mode.to_json()]
    assert eigen(system, at=[{"x1": 0.0, "x2": 0.0}]).fast_modes == ()


def test_a_fast_mode_names_the_states_that_dominate_it_by_their_ranges() -> None:
    # u and v exchange quickly: u - v relaxes at the rate -50, along (1, -1); w follows slowly.
    def rhs(w: object, u: object, v: object) -> tuple[object, ...]:
        return -0.2 * w + 0.01 * u, 25 * (v - u), 25 * (u - v) - 0.1 * v  # type: ignore[operator]

    values = np.array([[1.0, 0.5, 0.4], [0.9, 0.45, 0.45]])
    item = Trajectory("one", 0.0, np.arange(2.0), values, np.ones((2, 3)), np.full((2, 3), np.nan), np.zeros(0))
    data = Trajectories((item,), ("w", "u", "v"))
    ranges = {"w": (0.0, 1.0), "u": (0.0, 1.0), "v": (0.0, 1.0)}
    (mode,) = eigen(textbook("exchange", ("w", "u", "v"), rhs, {}, ranges), along=data).fast_modes
    assert (mode.rank, set(mode.states)) == (2, {"u", "v"})
    # Measured by its range, the part of u becomes small where u is plentiful.
    (mode,) = eigen(
        textbook("plentiful", ("w", "u", "v"), rhs, {}, {**ranges, "u": (0.0, 10.0)}), along=data
    ).fast_modes
    assert mode.states == ("v",)
    assert mode.to_json()["states"] == ["v"]
