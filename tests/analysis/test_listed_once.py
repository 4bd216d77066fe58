"""Each branch, special point and cycle of a diagram is listed once, wherever the search for it begins."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.diagram import Diagram
from gbspec.analysis.systems.system import System
from tests.analysis.textbook import roessler, textbook

VALUES = (4, 5, 8, 9, 17)
"""Numbers of parameter values at which searches begin: with odd ones some lie on folds and branch points."""


def one_state(rhs: Any) -> System:
    """x' = rhs(x, mu) with x in [-2, 2]."""
    ranges = {"x": (-2.0, 2.0)}
    return textbook("one", ("x",), lambda x, mu: (rhs(x, mu),), {"mu": float("nan")}, ranges)


def found(system: System, values: int) -> Diagram:
    return bifurcate(system, "mu", -1.0, 1.0, BifurcationOptions(values=values, cycles=False))


def points(diagram: Diagram) -> list[tuple[str, float, float]]:
    return [(one.kind, round(one.value, 6) + 0.0, round(float(one.state[0]), 6) + 0.0) for one in diagram.special]


@pytest.mark.parametrize("values", VALUES)
def test_a_closed_branch(values: int) -> None:
    diagram = found(one_state(lambda x, mu: 0.25 - mu**2 - x**2), values)
    (branch,) = diagram.branches
    assert branch.ends == ("closed", "closed")
    assert "closed, closed" not in str(diagram)
    assert "; closed" in str(diagram)
    assert branch.points[0].value == pytest.approx(branch.points[-1].value)
    assert branch.points[0].state == pytest.approx(branch.points[-1].state)
    assert points(diagram) == [("fold", -0.5, 0.0), ("fold", 0.5, 0.0)]


@pytest.mark.parametrize("values", VALUES)
def test_branches_that_cross_at_a_subcritical_pitchfork(values: int) -> None:
    diagram = found(one_state(lambda x, mu: mu * x + x**3 - x**5), values)
    assert [branch.ends for branch in diagram.branches] == [("range", "range")] * 2
    fold = round(float(np.sqrt(0.5)), 6)
    assert sorted(points(diagram)) == [("branch", 0.0, 0.0), ("fold", -0.25, -fold), ("fold", -0.25, fold)]
    assert diagram.of_kind("branch")[0].branches == (0, 1)
    assert [one["branches"] for one in diagram.to_json()["special"]] == [[], [], [0, 1]]  # type: ignore[attr-defined]


@pytest.mark.parametrize("values", VALUES)
def test_branches_that_cross_at_a_transcritical_point(values: int) -> None:
    diagram = found(one_state(lambda x, mu: mu * x - x**2), values)
    assert [branch.ends for branch in diagram.branches] == [("range", "range")] * 2
    assert points(diagram) == [("branch", 0.0, 0.0)]
    assert "(of branches 0 and 1)" in str(diagram)
    slopes = sorted(np.ptp(branch.states) / np.ptp(branch.values) for branch in diagram.branches)
    assert slopes == pytest.approx([0.0, 1.0])


@pytest.mark.parametrize("values", VALUES)
@pytest.mark.parametrize("at", [0.0, 0.1])
def test_branches_that_cross_at_a_corner(values: int, at: float) -> None:
    diagram = found(one_state(lambda x, mu: ca.fabs(mu - at) - ca.fabs(x)), values)
    assert [branch.ends for branch in diagram.branches] == [("range", "range")] * 2
    assert points(diagram) == [("branch", at, 0.0)]
    assert diagram.special[0].branches == (0, 1)


@pytest.mark.parametrize("values", VALUES)
def test_a_fold_at_a_searched_value_is_on_one_branch(values: int) -> None:
    diagram = found(one_state(lambda x, mu: mu + x**2), values)
    assert len(diagram.branches) == 1
    assert points(diagram) == [("fold", 0.0, 0.0)]


@pytest.mark.parametrize("values", [8, 9])
def test_a_degenerate_point_of_a_branch_is_no_branch(values: int) -> None:
    def rhs(x: Any, y: Any, mu: Any) -> tuple[Any, ...]:
        return mu * (x + 0.5 * y) + x**2 + y**2, mu * (y - 0.3 * x) + x * y + 0.2 * y**2

    ranges = {"x": (-2.0, 2.0), "y": (-2.0, 2.0)}
    diagram = found(textbook("degenerate", ("x", "y"), rhs, {"mu": float("nan")}, ranges), values)
    assert all(len(branch.points) > 1 for branch in diagram.branches)


def test_branches_that_run_close_together_stay_two() -> None:
    diagram = found(one_state(lambda x, mu: (x - mu / 2.0) * (x - mu / 2.0 - 1e-4)), 9)
    assert len(diagram.branches) == 2


def test_cycles_found_by_simulation_that_were_followed_before() -> None:
    # Between 4.2 and 6 the flow is chaotic: near returns lead to cycles that no longer attract, some of them known.
    ranges = {"x": (-15.0, 15.0), "y": (-15.0, 15.0), "z": (0.0, 30.0)}
    diagram = bifurcate(replace(roessler(), ranges=ranges), "c", 1.0, 6.0)
    assert "settled" in [branch.start for branch in diagram.cycles[1:]]
    doubled = sorted(round(one.period or 0.0, 2) for one in diagram.of_kind("period_doubling"))
    assert len(doubled) == len(set(doubled))
    longest = [max(cycle.period for cycle in branch.cycles) for branch in diagram.cycles]
    assert len({round(period, 2) for period in longest}) == len(longest)


@pytest.mark.parametrize("values", VALUES)
def test_branches_that_turn_where_several_cross_have_no_fold_there(values: int) -> None:
    def rhs(x: Any, y: Any, mu: Any) -> tuple[Any, ...]:
        return mu * x - x**3 - 0.5 * x * y**2, mu * y - y**3 - 0.5 * y * x**2

    ranges = {"x": (-2.0, 2.0), "y": (-2.0, 2.0)}
    diagram = found(textbook("square", ("x", "y"), rhs, {"mu": float("nan")}, ranges), values)
    assert len(diagram.branches) == 5
    assert diagram.of_kind("fold") == ()
