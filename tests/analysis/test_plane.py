"""Hopf and fold curves in a plane of parameters, against closed forms and independent computations."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.plane import PlaneCurve, fold_curve, hopf_curve
from gbspec.analysis.systems.family import Family
from gbspec.analysis.systems.system import System
from gbspec.diagnostics import UserError
from tests.analysis.textbook import brusselator, cusp, textbook, urp


def lower_hopf(other: str, box: tuple[float, float]) -> PlaneCurve:
    point = bifurcate(urp(), "Da", 0.2, 0.5, BifurcationOptions(cycles=False)).of_kind("hopf")[0]
    value = {"B": 11.0, "beta": 3.0}[other]
    return hopf_curve(urp(), ("Da", other), ((0.05, 0.6), box), point.state, (point.value, value))


def test_bautin_point_over_the_heat_of_reaction() -> None:
    curve = lower_hopf("B", (8.0, 14.0))
    ((kind, point),) = curve.special
    assert kind == "bautin"
    assert point.values[1] == pytest.approx(11.01585, abs=2e-6)
    assert point.l1 == pytest.approx(0.0, abs=1e-9)
    assert curve.ends == ("range", "range")


def test_bautin_and_bogdanov_takens_points_over_the_cooling() -> None:
    curve = lower_hopf("beta", (1.0, 5.0))
    special = dict(curve.special)
    assert special["bautin"].values[1] == pytest.approx(2.98857, abs=5e-6)
    # At the end of the Hopf curve, trace and determinant of the Jacobian vanish together.
    takens = special["bogdanov_takens"]
    jacobian = Family(urp(beta=takens.values[1]), "Da").linear(takens.state, takens.values[0])[1]
    assert np.trace(jacobian) == pytest.approx(0.0, abs=1e-9)
    assert np.linalg.det(jacobian) == pytest.approx(0.0, abs=1e-9)
    assert "bogdanov_takens" in curve.ends


def test_every_point_of_a_hopf_curve_is_one() -> None:
    curve = lower_hopf("B", (8.0, 14.0))
    for point in curve.points[::10]:
        values = np.linalg.eigvals(Family(urp(B=point.values[1]), "Da").linear(point.state, point.values[0])[1])
        assert values.real == pytest.approx([0.0, 0.0], abs=1e-9)
        assert np.abs(values.imag) == pytest.approx([point.frequency] * 2)


def test_the_hopf_curve_of_the_brusselator() -> None:
    curve = hopf_curve(brusselator(), ("B", "A"), ((0.0, 8.0), (0.5, 2.0)), np.array([1.0, 2.0]), (2.0, 1.0))
    assert len(curve.points) > 20
    for point in curve.points:
        assert point.values[0] == pytest.approx(1.0 + point.values[1] ** 2)
    assert curve.special == ()


def bogdanov() -> System:
    """The Bogdanov-Takens normal form (Kuznetsov, section 8.4): Hopf on a = 0, b < 0, folds on 4 a = b^2."""

    def rhs(x: object, y: object, a: object, b: object) -> tuple[object, ...]:
        return y, a + b * x + x**2 - x * y  # type: ignore[operator]

    nan = float("nan")
    return textbook("bogdanov", ("x", "y"), rhs, {"a": nan, "b": nan}, {"x": (-2.0, 2.0), "y": (-2.0, 2.0)})


@pytest.mark.parametrize("b", [-0.5, -4.0])  # with a frequency above one the greatest part of r is that of y
def test_the_bogdanov_takens_normal_form(b: float) -> None:
    boxes = ((-1.0, 1.0), (-5.0, 1.0))
    hopf = hopf_curve(bogdanov(), ("a", "b"), boxes, np.zeros(2), (0.0, b))
    assert {kind for kind, _ in hopf.special} == {"bogdanov_takens"}
    (_, takens), *_ = hopf.special
    assert takens.values == pytest.approx((0.0, 0.0), abs=1e-9)
    assert max(abs(point.values[0]) for point in hopf.points) < 1e-9
    fold = fold_curve(bogdanov(), ("a", "b"), boxes, np.array([0.25, 0.0]), (0.0625, -0.5))
    assert max(abs(4 * point.values[0] - point.values[1] ** 2) for point in fold.points) < 1e-9
    assert max(point.values[1] for point in fold.points) > 0.95


def test_the_cusp_point() -> None:
    fold = 2.0 / 3.0 * np.sqrt(1.0 / 3.0)
    boxes = ((-1.0, 1.0), (-1.0, 2.0))
    curve = fold_curve(cusp(), ("h", "r"), boxes, np.array([-np.sqrt(1.0 / 3.0)]), (fold, 1.0))
    ((kind, point),) = curve.special
    assert kind == "cusp"
    assert point.values == pytest.approx((0.0, 0.0), abs=1e-9)
    for one in curve.points:
        assert abs(one.values[0]) == pytest.approx(2.0 / 3.0 * max(one.values[1], 0.0) ** 1.5 / np.sqrt(3.0), abs=1e-12)
    assert {np.sign(one.values[0]) for one in (curve.points[0], curve.points[-1])} == {-1.0, 1.0}


def test_json_of_a_curve() -> None:
    curve = hopf_curve(brusselator(), ("B", "A"), ((1.5, 3.0), (0.8, 1.2)), np.array([1.0, 2.0]), (2.0, 1.0))
    document = json.loads(json.dumps(curve.to_json()))
    assert list(document) == ["type", "parameters", "points", "special", "ends"]
    assert set(document["points"][0]["values"]) == {"B", "A"}


def test_a_misspelt_second_parameter_is_named() -> None:
    with pytest.raises(UserError) as caught:
        hopf_curve(brusselator(), ("B", "a"), ((0.0, 8.0), (0.5, 2.0)), np.array([1.0, 2.0]), (2.0, 1.0))
    assert caught.value.diagnostics[0].code == "GB872"
