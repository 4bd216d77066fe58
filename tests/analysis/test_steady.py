from __future__ import annotations

import numpy as np
import pytest

from gbspec.analysis.systems.points import quasirandom_points
from gbspec.analysis.systems.roots import ordered_eigenvalues
from gbspec.analysis.systems.steady import distinct, steady_states
from gbspec.diagnostics import UserError
from tests.analysis.textbook import baltzis_fredrickson, brusselator, cusp, lorenz, urp


def test_the_one_steady_state_of_the_brusselator() -> None:
    (found,) = steady_states(brusselator(A=1.5, B=4.0))
    assert found.state == pytest.approx([1.5, 4.0 / 1.5], abs=1e-12)
    assert found.rhs_norm < 1e-12
    assert not found.stable


def test_all_three_steady_states_of_lorenz() -> None:
    found = steady_states(lorenz(r=28.0))
    c = np.sqrt(8.0 / 3.0 * 27.0)
    assert np.array([one.state for one in found]) == pytest.approx(
        np.array([[-c, -c, 27.0], [0.0, 0.0, 0.0], [c, c, 27.0]]), abs=1e-10
    )
    assert [one.stable for one in found] == [False, False, False]


def test_one_state_systems() -> None:
    found = steady_states(cusp(h=0.1))
    assert [float(one.state[0]) for one in found] == pytest.approx(sorted(np.roots([-1.0, 0.0, 1.0, 0.1]).real))
    assert [one.stable for one in found] == [True, False, True]


def test_negative_concentrations_are_omitted() -> None:
    found = steady_states(baltzis_fredrickson(7.3 * 0.68))
    assert found
    assert all(np.all(one.state >= -1e-6 * np.array([100, 5, 2, 250, 3000, 2])) for one in found)
    assert any(one.state[0] < 1e-6 and one.state[3] == pytest.approx(250.0) for one in found)


def test_a_missing_number_is_named() -> None:
    with pytest.raises(UserError) as caught:
        steady_states(urp())
    assert caught.value.diagnostics[0].code == "GB871"
    assert "`Da`" in caught.value.diagnostics[0].message


def test_states_outside_their_range_are_named() -> None:
    (found,) = steady_states(brusselator(A=1.0, B=7.0))
    assert found.outside == ("y",)


def test_eigenvalues_are_ordered_by_real_part_with_pairs_together() -> None:
    matrix = np.array([[-3.0, 0, 0], [0, 0.5, -2.0], [0, 2.0, 0.5]])
    assert ordered_eigenvalues(matrix) == pytest.approx([0.5 + 2j, 0.5 - 2j, -3.0])


def test_points_have_low_discrepancy() -> None:
    points = quasirandom_points(256, 3)
    assert points.shape == (256, 3)
    counts = np.histogramdd(points, bins=(2, 2, 2), range=[(0, 1)] * 3)[0]
    assert counts.min() >= 26
    assert not np.array_equal(points, quasirandom_points(256, 3, seed=1))


def test_distinct_points_are_in_lexicographic_order_in_any_units() -> None:
    # In units of the first state's scale the first coordinates are 1e-4 apart: they decide, though small.
    scale = np.array([1e-3, 1.0])
    points = np.array([[2e-7, 0.0], [1e-7, 1.0], [2e-7, 1e-7], [3e-7, 0.0]])
    assert distinct(points, scale).tolist() == [[1e-7, 1.0], [2e-7, 0.0], [3e-7, 0.0]]
