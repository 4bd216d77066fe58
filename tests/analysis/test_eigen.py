from __future__ import annotations

import json

import numpy as np
import pytest

from gbspec.analysis.eigen import eigen, format_eigenvalue
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.diagnostics import UserError
from tests.analysis.textbook import brusselator, urp


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
    assert list(document) == ["points"]
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
