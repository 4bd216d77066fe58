"""All Hopf and fold curves of a plane, found without initial guesses."""

from __future__ import annotations

import json
from typing import Any

import casadi as ca
import numpy as np
import pytest

from gbspec.analysis.bifurcation.plane_diagram import PlaneDiagram, bifurcation_plane
from gbspec.diagnostics import UserError
from gbspec.report.files import plane
from tests.analysis.textbook import brusselator, cusp, textbook, urp


@pytest.fixture(scope="module")
def reactor() -> PlaneDiagram:
    return bifurcation_plane(urp(), ("Da", "beta"), ((0.05, 0.6), (1.0, 5.0)))


def test_the_curves_of_the_reactor(reactor: PlaneDiagram) -> None:
    assert sorted(curve.kind for curve in reactor.curves) == ["fold", "hopf"]
    special = {kind: point for curve in reactor.curves for kind, point in curve.special}
    assert set(special) == {"bautin", "bogdanov_takens", "cusp"}
    # Folds of a first-order reaction need B > 4 (1 + beta); they begin at x2 = 2, that is Da = (1 + beta)... exp(-2).
    assert special["cusp"].values == pytest.approx((np.exp(-2.0), 11.0 / 4.0 - 1.0), abs=1e-6)
    assert special["bautin"].values[1] == pytest.approx(2.98857, abs=5e-6)


def test_every_point_names_the_ranges_it_leaves(reactor: PlaneDiagram) -> None:
    for curve in reactor.curves:
        for point in curve.points:
            assert ("Da" in point.outside) is not (0.2 - 1e-6 <= point.values[0] <= 0.5 + 1e-6)


def test_curves_reach_the_edges_of_the_box(reactor: PlaneDiagram) -> None:
    (fold,) = (curve for curve in reactor.curves if curve.kind == "fold")
    assert fold.ends == ("range", "range")
    for point in (fold.points[0], fold.points[-1]):
        assert min(abs(point.values[0] - 0.05), abs(point.values[1] - 1.0)) < 1e-9


@pytest.mark.parametrize("radius", [0.45, 0.5, 0.55])
def test_a_closed_curve_is_listed_once(radius: float) -> None:
    def rhs(x: Any, a: Any, b: Any) -> tuple[Any, ...]:
        return (radius**2 - a**2 - b**2 - x**2,)

    names = {"a": float("nan"), "b": float("nan")}
    diagram = bifurcation_plane(
        textbook("ball", ("x",), rhs, names, {"x": (-2.0, 2.0)}), ("a", "b"), ((-1, 1), (-1, 1))
    )
    (curve,) = diagram.curves
    assert curve.points[0].values == pytest.approx(curve.points[-1].values)
    assert "; closed" in str(diagram)


def test_a_curve_is_followed_once() -> None:
    diagram = bifurcation_plane(brusselator(), ("B", "A"), ((0.0, 8.0), (0.5, 2.0)))
    (curve,) = diagram.curves
    spanned = [point.values[1] for point in curve.points]
    assert (min(spanned), max(spanned)) == pytest.approx((0.5, 2.0), abs=1e-9)


def test_folds_are_found_along_either_parameter() -> None:
    (curve,) = bifurcation_plane(cusp(), ("h", "r"), ((-1.0, 1.0), (-1.0, 2.0))).curves
    assert {round(point.values[0], 6) for point in (curve.points[0], curve.points[-1])} == {-1.0, 1.0}


def test_a_diagram_prints_draws_and_writes_itself(reactor: PlaneDiagram) -> None:
    text = str(reactor)
    assert "Bogdanov-Takens point at Da = 0.12299534, beta = 1.6025806" in text
    document = json.loads(json.dumps(reactor.to_json()))
    assert document["parameters"] == ["Da", "beta"]
    assert set(document["curves"][0]["points"][0]["state"]) == {"x1", "x2"}
    (axes,) = plane(reactor, [reactor], reactor).axes
    labels = set(axes.get_legend_handles_labels()[1])
    assert {"truth", "fold", "Hopf, supercritical", "Hopf, subcritical", "Bautin point", "cusp"} <= labels


def test_a_plane_without_curves_says_so() -> None:
    diagram = bifurcation_plane(urp(), ("Da", "beta"), ((0.2, 0.21), (4.0, 5.0)))
    assert diagram.curves == ()
    assert "no Hopf points and no folds" in str(diagram)


def test_a_plane_with_folds_at_corners_says_that_they_are_not_followed() -> None:
    ranges = {"x": (-2.0, 2.0)}
    system = textbook("corner", ("x",), lambda x, a, b: (a + b - ca.fabs(x),), {"a": 0.0, "b": 0.0}, ranges)
    diagram = bifurcation_plane(system, ("a", "b"), ((-1.0, 1.0), (-0.5, 0.5)))
    assert diagram.curves == ()
    assert "non-smooth folds, which are not followed" in str(diagram)
    assert "no Hopf points and no other folds" in str(diagram)


@pytest.mark.parametrize(
    ("names", "boxes", "code"),
    [
        (("Da", "betta"), ((0.1, 0.5), (1.0, 5.0)), "GB872"),
        (("Da", "beta"), ((0.1, 0.5), (5.0, 1.0)), "GB875"),
    ],
)
def test_invalid_planes(names: tuple[str, str], boxes: tuple[tuple[float, float], ...], code: str) -> None:
    with pytest.raises(UserError) as caught:
        bifurcation_plane(urp(), names, (boxes[0], boxes[1]))
    assert caught.value.diagnostics[0].code == code
