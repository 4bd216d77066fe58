from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.diagram import Diagram
from gbspec.analysis.bifurcation.members import with_intervals
from gbspec.analysis.systems.system import system_of
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.diagnostics import UserError
from gbspec.operations.models import reference
from tests.analysis.conftest import model_of, nearly_true
from tests.analysis.textbook import baltzis_fredrickson, lorenz, pitchfork, urp, van_der_pol


@pytest.fixture(scope="module")
def learned(urp_evaluator: Evaluator) -> Diagram:
    return bifurcate(system_of(urp_evaluator, model_of("urp_gb2")), "Da", 0.2, 0.5)


@pytest.fixture(scope="module")
def true() -> Diagram:
    subject = reference(model_of("urp_gb2"))
    return bifurcate(system_of(subject.evaluator, subject.model), "Da", 0.2, 0.5)


def test_the_bundled_reactor_has_its_published_hopf_points(true: Diagram) -> None:
    points = true.of_kind("hopf")
    assert [point.value for point in points] == pytest.approx([0.2802749, 0.4195478], abs=1e-6)
    assert [point.criticality for point in points] == ["super", "super"]
    assert len(true.branches) == 1
    assert [branch.end for branch in true.cycles] == ["hopf"]
    stable = [cycle for cycle in true.cycles[0].cycles if cycle.stable]
    assert min(cycle.value for cycle in stable) < 0.2805
    assert max(cycle.value for cycle in stable) > 0.419


def test_a_fitted_network_uses_the_same_functions(true: Diagram, learned: Diagram) -> None:
    values = [point.value for point in learned.of_kind("hopf")]
    assert values == pytest.approx([point.value for point in true.of_kind("hopf")], rel=0.03)
    periods = [
        float(
            np.interp(
                0.35, *map(np.array, zip(*sorted((c.value, c.period) for c in one.cycles[0].cycles), strict=True))
            )
        )
        for one in (true, learned)
    ]
    assert periods[1] == pytest.approx(periods[0], rel=0.02)


def test_json_has_the_keys_of_the_contract(true: Diagram) -> None:
    document = json.loads(json.dumps(true.to_json()))
    assert list(document)[:5] == ["parameter", "range", "branches", "special", "cycles"]
    assert document["parameter"] == "Da"
    assert document["range"] == [0.2, 0.5]
    assert list(document["branches"][0]["points"][0]) == ["value", "state", "stable", "eigenvalues", "outside"]
    keys = ["type", "value", "state", "criticality", "period", "interval"]
    assert list(document["special"][0])[:6] == keys
    assert document["special"][0]["type"] == "hopf"
    keys = ["value", "period", "max", "min", "stable", "multipliers"]
    assert list(document["cycles"][0])[:6] == keys
    assert set(document["cycles"][0]["max"]) == {"x1", "x2"}


def test_a_diagram_prints_itself(true: Diagram) -> None:
    text = str(true)
    assert "Hopf point at Da = 0.2802749" in text
    assert "supercritical" in text
    assert "end: hopf" in text


def test_over_a_constant_outside_the_learned_range(urp_instance: Any) -> None:
    system = system_of(Evaluator(urp_instance), model_of("urp_gb2")).with_values({"Da": 0.3})
    subject = reference(model_of("urp_gb2"), {"Da": 0.3})
    options = BifurcationOptions(cycles=False)
    values = [
        [point.value for point in bifurcate(one, "B", 9.0, 13.0, options).of_kind("hopf")]
        for one in (system, system_of(subject.evaluator, subject.model))
    ]
    assert len(values[1]) == 1
    assert values[0] == pytest.approx(values[1], rel=0.02)


def test_both_branches_of_a_pitchfork_are_found_from_one_branch_point() -> None:
    diagram = bifurcate(pitchfork(), "r", -1.0, 1.0, BifurcationOptions(values=2, starts=1))
    ends = sorted(
        round(float(branch.points[i].state[0]), 6)
        for branch in diagram.branches
        for i in (0, -1)
        if branch.points[i].value > 0.999
    )
    assert ends == [-1.0, 0.0, 1.0]
    assert [point.kind for point in diagram.special] == ["branch"]


def test_lorenz_has_its_pitchfork_and_both_hopf_points() -> None:
    diagram = bifurcate(lorenz(), "r", 0.5, 30.0, BifurcationOptions(cycles=False))
    assert [point.kind for point in diagram.special] == ["branch", "hopf", "hopf"]
    assert [point.value for point in diagram.special] == pytest.approx([1.0, 470 / 19, 470 / 19], abs=1e-8)
    assert [point.criticality for point in diagram.special[1:]] == ["sub", "sub"]


def test_cycles_without_a_hopf_point_in_the_range_come_from_the_flow() -> None:
    diagram = bifurcate(van_der_pol(), "mu", 1.0, 6.0)
    (branch,) = diagram.cycles
    assert branch.start == "settled"
    values = [cycle.value for cycle in branch.cycles]
    assert (min(values), max(values)) == pytest.approx((1.0, 6.0))
    assert branch.cycles[values.index(min(values))].period == pytest.approx(6.66328686, abs=1e-7)


def test_the_chemostat_has_one_supercritical_hopf_point() -> None:
    diagram = bifurcate(baltzis_fredrickson(), "theta", 4.8, 5.1)
    (hopf,) = diagram.of_kind("hopf")
    assert hopf.criticality == "super"
    assert hopf.value == pytest.approx(4.93262, abs=1e-5)
    assert any(cycle.stable for branch in diagram.cycles for cycle in branch.cycles)


def test_members_give_intervals() -> None:
    options = BifurcationOptions(cycles=False)
    diagrams = [bifurcate(urp(B=B), "Da", 0.2, 0.5, options) for B in (11.0, 10.99, 11.01)]
    for point, low, high in zip(
        with_intervals(diagrams).special, diagrams[2].special, diagrams[1].special, strict=True
    ):
        assert point.interval == tuple(sorted((low.value, high.value)))
        assert point.interval[0] <= point.value <= point.interval[1]


def test_members_that_disagree_give_no_interval() -> None:
    options = BifurcationOptions(cycles=False)
    one = bifurcate(urp(), "Da", 0.2, 0.5, options)
    found = with_intervals([one, replace(one, special=one.special[:1])])
    assert [point.interval for point in found.special] == [None, None]


def test_an_invalid_range() -> None:
    with pytest.raises(UserError) as caught:
        bifurcate(urp(), "Da", 0.5, 0.2)
    assert caught.value.diagnostics[0].code == "GB875"


def test_a_model_that_depends_on_time_has_no_diagram() -> None:
    import casadi as ca

    from gbspec.analysis.systems.system import System

    t, x, c, u, k = (ca.SX.sym(name, size) for name, size in zip("txcuk", (1, 1, 1, 0, 0), strict=True))
    system = System("forced", ("x",), ca.Function("rhs", [t, x, c, u, k], [-x + ca.sin(t) + c]), ("a",))
    with pytest.raises(UserError) as caught:
        bifurcate(system, "a", 0.0, 1.0)
    assert caught.value.diagnostics[0].code == "GB873"


def test_the_helper_network_is_near_the_truth() -> None:
    # The other tests depend on it: the fitted rate is accurate to 2 % of its range along the cycles.
    instance = nearly_true()
    points = np.random.default_rng(5).uniform([0.2, 0.5, 0.2], [0.95, 3.6, 0.5], (500, 3))
    rate = points[:, 2] * (1 - points[:, 0]) * np.exp(points[:, 1])
    found = Evaluator(instance).functions_many("phi", points)
    assert np.max(np.abs(found - rate)) < 0.02 * np.ptp(rate)
