"""Branches of steady states against published and closed-form numbers."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.continuation import SteadyCurve
from gbspec.analysis.bifurcation.curve import Curve, Steps
from gbspec.analysis.bifurcation.hopf import analyse_hopf
from gbspec.analysis.systems.family import Family
from gbspec.analysis.systems.steady import steady_states
from gbspec.analysis.systems.system import System
from gbspec.diagnostics import UserError
from tests.analysis.textbook import brusselator, cusp, lorenz, morris_lecar, pitchfork, textbook, urp


def special(system: System, name: str, low: float, high: float, at: float) -> list[tuple[str, float, np.ndarray]]:
    """The special points of the branches through the first steady state at a value."""
    curve = SteadyCurve(Family(system, name), low, high)
    state = steady_states(curve.family.at(at))[0].state
    found = []
    for forward in (True, False):
        start = curve.start(state, at, forward)
        assert start is not None
        for kind, point in curve.follow(start).special:
            x, value = curve.unscaled(point.y)
            found.append((kind, value, x))
    return sorted(found, key=lambda one: one[1])


def test_hopf_points_of_the_reactor_to_1e_8() -> None:
    found = special(urp(), "Da", 0.2, 0.5, 0.35)
    assert [kind for kind, _, _ in found] == ["hopf", "hopf"]
    # Independent computation in float64; the source (the paper) prints 0.280275 and 0.419548.
    assert [value for _, value, _ in found] == pytest.approx([0.2802749000, 0.4195478413], abs=1e-8)


def test_first_lyapunov_coefficients_of_the_reactor() -> None:
    found = special(urp(), "Da", 0.2, 0.5, 0.35)
    family = Family(urp(), "Da")
    hopfs = [analyse_hopf(family, x, value) for _, value, x in found]
    assert [hopf.l1 for hopf in hopfs] == pytest.approx([-0.00481, -0.284], rel=2e-3)
    assert [hopf.criticality for hopf in hopfs] == ["super", "super"]


def test_the_lower_hopf_point_turns_subcritical_beyond_the_bautin_point() -> None:
    # At Da's lower Hopf point the criticality changes at B = 11.01585.
    signs = []
    for B in (11.0155, 11.0163):
        (_, value, x), _ = special(urp(B=B), "Da", 0.2, 0.5, 0.35)
        signs.append(analyse_hopf(Family(urp(B=B), "Da"), x, value).criticality)
    assert signs == ["super", "sub"]


@pytest.mark.parametrize("A", [0.8, 1.0, 1.5])
def test_hopf_point_of_the_brusselator(A: float) -> None:
    # Nicolis and Prigogine, Self-Organization in Nonequilibrium Systems (1977): B = 1 + A^2, frequency A.
    ((kind, value, x),) = special(brusselator(A=A), "B", 0.5, 5.0, 0.7)
    hopf = analyse_hopf(Family(brusselator(A=A), "B"), x, value)
    assert kind == "hopf"
    assert value == pytest.approx(1 + A**2, abs=1e-9)
    assert hopf.frequency == pytest.approx(A, abs=1e-8)
    assert hopf.criticality == "super"


def test_the_hopf_point_of_lorenz_is_subcritical() -> None:
    # Sparrow, The Lorenz Equations (1982): r = sigma (sigma + b + 3)/(sigma - b - 1) = 470/19.
    found = [one for one in special(lorenz(), "r", 2.0, 30.0, 20.0) if one[0] == "hopf"]
    assert found[0][1] == pytest.approx(470.0 / 19.0, abs=1e-8)
    assert analyse_hopf(Family(lorenz(), "r"), found[0][2], found[0][1]).criticality == "sub"


def test_hopf_points_of_morris_lecar_are_subcritical() -> None:
    # Ermentrout and Terman, Mathematical Foundations of Neuroscience (2010), section 3.3: about 94 and 212.
    found = special(morris_lecar(), "current", 0.0, 300.0, 50.0)
    assert [value for _, value, _ in found] == pytest.approx([93.858, 212.019], abs=5e-3)
    family = Family(morris_lecar(), "current")
    assert [analyse_hopf(family, x, value).criticality for _, value, x in found] == ["sub", "sub"]


@pytest.mark.parametrize("r", [0.5, 1.0, 2.0])
def test_folds_of_the_cusp(r: float) -> None:
    # Strogatz, Nonlinear Dynamics and Chaos, section 3.6: h = +-2/3 r sqrt(r/3).
    found = special(cusp(r=r), "h", -3.0, 3.0, -2.5)
    h = 2.0 / 3.0 * r * np.sqrt(r / 3.0)
    assert [kind for kind, _, _ in found] == ["fold", "fold"]
    assert [value for _, value, _ in found] == pytest.approx([-h, h], abs=1e-10)
    assert [float(x[0]) for _, _, x in found] == pytest.approx([np.sqrt(r / 3.0), -np.sqrt(r / 3.0)], abs=1e-7)


def test_stability_changes_at_the_folds() -> None:
    curve = SteadyCurve(Family(cusp(), "h"), -1.0, 1.0)
    start = curve.start(np.array([-1.3]), -1.0, True)
    assert start is not None
    points = [curve.steady_point(point.y) for point in curve.follow(start).points]
    for point in points:
        assert point.stable == (abs(point.state[0]) > np.sqrt(1.0 / 3.0))
    assert points[-1].value == pytest.approx(1.0, abs=1e-12)
    assert points[-1].state[0] == pytest.approx(1.3247179572)


def test_branch_point_of_the_pitchfork_and_its_other_branch() -> None:
    curve = SteadyCurve(Family(pitchfork(), "r"), -1.0, 1.0)
    start = curve.start(np.zeros(1), -0.9, True)
    assert start is not None
    followed = curve.follow(start)
    ((kind, point),) = followed.special
    assert (kind, curve.unscaled(point.y)[1]) == ("branch", pytest.approx(0.0, abs=1e-9))
    (tangent,) = curve.crossing_tangents(point)
    assert abs(tangent[0]) == pytest.approx(1.0, abs=1e-6)
    off = curve.switch(point, tangent)
    assert off is not None
    x, r = curve.unscaled(off.y)
    assert x[0] != 0.0
    assert r == pytest.approx(x[0] ** 2)


def test_a_transcritical_point_has_another_branch_too() -> None:
    system = textbook("logistic", ("x",), lambda x, r: (r * x - x**2,), {"r": float("nan")}, {"x": (-1.0, 1.0)})
    curve = SteadyCurve(Family(system, "r"), -0.5, 0.7)
    start = curve.start(np.zeros(1), -0.4, True)
    assert start is not None
    points = [point for kind, point in curve.follow(start).special if kind == "branch"]
    (tangent,) = curve.crossing_tangents(points[0])
    off = curve.switch(points[0], tangent)
    assert off is not None
    x, r = curve.unscaled(off.y)
    assert x[0] == pytest.approx(r)


def test_a_closed_branch_is_followed_once_around() -> None:
    def ring(x: object, p: object) -> tuple[object, ...]:
        return (1.0 - x**2 - p**2,)  # type: ignore[operator]

    system = textbook("ring", ("x",), ring, {"p": float("nan")}, {"x": (-2.0, 2.0)})
    curve = SteadyCurve(Family(system, "p"), -2.0, 2.0, Steps(most=0.02))
    start = curve.start(np.array([1.0]), 0.0, True)
    assert start is not None
    followed = curve.follow(start)
    assert followed.end == "closed"
    assert sorted(round(curve.unscaled(point.y)[1], 9) for _, point in followed.special) == [-1.0, 1.0]


def test_a_curve_of_centres_has_no_special_points_and_is_not_stable() -> None:
    # Lotka and Volterra: the eigenvalues +-i sqrt(r m) have real parts of rounding size, whose signs mean nothing.
    def rhs(prey: Any, predator: Any, m: Any) -> tuple[Any, ...]:
        eaten = 0.028 * prey * predator
        return 0.55 * prey - eaten, 0.857 * eaten - m * predator

    ranges = {"prey": (2.0, 80.0), "predator": (2.0, 60.0), "m": (0.4, 1.2)}
    system = textbook("lotka_volterra", ("prey", "predator"), rhs, {"m": float("nan")}, ranges)
    found = bifurcate(system, "m", 0.4, 1.2)
    assert not found.special
    inner = [one for one in found.branches if one.points[0].state.min() > 1.0]
    assert [one.ends for one in inner] == [("range", "range")]
    assert not any(point.stable for one in inner for point in one.points)


def test_a_zero_is_not_located_where_the_test_keeps_its_sign() -> None:
    line = Curve(lambda y: (np.array([y[0]]), np.array([[1.0, 0.0]])))
    start = line.point(np.zeros(2), np.array([0.0, 1.0]))
    assert start is not None
    assert line.locate(start, 1.0, lambda point: point.y[1] + 0.5) is None
    at_end = line.locate(start, 1.0, lambda point: 1.0 + 1e-13 - point.y[1])
    assert at_end is not None
    assert at_end.y[1] == pytest.approx(1.0)
    inside = line.locate(start, 1.0, lambda point: 0.25 - point.y[1])
    assert inside is not None
    assert inside.y[1] == pytest.approx(0.25)


def test_what_cannot_be_varied_is_named() -> None:
    with pytest.raises(UserError) as caught:
        Family(urp(), "Db")
    assert caught.value.diagnostics[0].code == "GB872"
    assert "`Da`" in caught.value.diagnostics[0].help


def test_exact_derivatives_agree_with_differences() -> None:
    family = Family(urp(), "Da")
    x, u, v = np.array([0.4, 1.3]), np.array([0.3, -0.7]), np.array([1.0, 0.2])
    h = 1e-5
    ahead, behind = family.linear(x + h * u, 0.3)[1], family.linear(x - h * u, 0.3)[1]
    assert family.bilinear(x, 0.3, u, v)[0] == pytest.approx((ahead - behind) @ v / (2 * h), rel=1e-8)
    third = family.bilinear(x + h * v, 0.3, u, v)[0] - family.bilinear(x - h * v, 0.3, u, v)[0]
    assert family.trilinear(x, 0.3, u, v, v)[0] == pytest.approx(third / (2 * h), rel=1e-8)


@pytest.mark.parametrize("values", [4, 5, 9])
def test_a_branch_that_turns_at_a_corner_has_a_fold_there(values: int) -> None:
    def rhs(x: Any, y: Any, mu: Any) -> tuple[Any, ...]:
        return mu - ca.fabs(x) + 0.3 * y, x - y - 0.2

    system = textbook("corner", ("x", "y"), rhs, {"mu": float("nan")}, {"x": (-2.0, 2.0), "y": (-2.0, 2.0)})
    diagram = bifurcate(system, "mu", -1.0, 1.0, BifurcationOptions(values=values, cycles=False))
    (branch,) = diagram.branches
    assert branch.ends == ("range", "range")
    (fold,) = diagram.special
    assert fold.kind == "nonsmooth_fold"
    assert fold.value == pytest.approx(0.06, abs=1e-11)
    assert fold.state == pytest.approx([0.0, -0.2], abs=1e-11)
    assert "non-smooth fold at mu = 0.06:" in str(diagram)


def test_a_branch_goes_on_around_a_corner_at_which_it_does_not_turn() -> None:
    def rhs(x: Any, mu: Any) -> tuple[Any, ...]:
        return (mu - x - 4.0 * ca.fmax(x, 0.0),)

    system = textbook("bent", ("x",), rhs, {"mu": float("nan")}, {"x": (-2.0, 2.0)})
    diagram = bifurcate(system, "mu", -1.0, 1.0, BifurcationOptions(cycles=False))
    (branch,) = diagram.branches
    assert branch.ends == ("range", "range")
    assert diagram.special == ()
    assert sorted(branch.states[[0, -1], 0]) == pytest.approx([-1.0, 0.2])


@pytest.mark.parametrize("middle", [0.03, 0.0])
def test_a_closed_branch_with_corners_is_followed_once_around(middle: float) -> None:
    # At middle 0 searches begin at corners.
    def rhs(x: Any, mu: Any) -> tuple[Any, ...]:
        return (0.5 - ca.fabs(x) - ca.fabs(mu - middle),)

    system = textbook("diamond", ("x",), rhs, {"mu": float("nan")}, {"x": (-2.0, 2.0)})
    diagram = bifurcate(system, "mu", -1.0, 1.0, BifurcationOptions(cycles=False))
    assert [branch.ends for branch in diagram.branches] == [("closed", "closed")]
    assert len(diagram.branches[0].points) < 200
    assert diagram.branches[0].points[0].state == pytest.approx(diagram.branches[0].points[-1].state)
    folds = [point.value for point in diagram.of_kind("nonsmooth_fold")]
    assert folds == pytest.approx([middle - 0.5, middle + 0.5])


def test_a_step_does_not_lead_to_another_branch() -> None:
    # A chemostat with the least of two limitations: at N = D the steady states with X > 0 are a line of constant N that
    # turns at a corner. Newton's method from a point of the branch without X just beyond N = D leads to that corner.
    def rhs(S: Any, X: Any, N: Any) -> tuple[Any, ...]:
        rate = ca.fmin(S, N)
        return 0.5 * (2.0 - S) - rate * X, (rate - 0.5) * X

    system = textbook("chemostat", ("S", "X"), rhs, {"N": float("nan")}, {"S": (0.0, 4.0), "X": (0.0, 4.0)})
    diagram = bifurcate(system, "N", 0.2, 2.2, BifurcationOptions(cycles=False))
    (washout,) = [branch for branch in diagram.branches if np.max(branch.states[:, 1]) < 1e-9]
    assert washout.ends == ("range", "range")
    (crossing,) = diagram.of_kind("branch")
    assert crossing.value == pytest.approx(0.5)
    assert crossing.branches == (0, 1)
    for branch in diagram.branches:
        steps = np.diff(np.column_stack([branch.values / 2.0, branch.states / 4.0]), axis=0)
        assert np.max(np.abs(steps)) < 0.05


def test_both_sides_of_a_jump_are_branches_of_their_own() -> None:
    def rhs(x: Any, mu: Any) -> tuple[Any, ...]:
        return (ca.if_else(x > 0.5, 1.0, 0.0) + mu - x,)

    system = textbook("jump", ("x",), rhs, {"mu": float("nan")}, {"x": (-2.0, 2.0)})
    diagram = bifurcate(system, "mu", -1.0, 1.0, BifurcationOptions(cycles=False))
    ends = sorted((float(min(branch.values)), float(max(branch.values))) for branch in diagram.branches)
    assert np.array(ends) == pytest.approx(np.array([[-1.0, 0.5], [-0.5, 1.0]]), abs=1e-6)
    assert all(branch.states[:, 0] - branch.values == pytest.approx(i) for i, branch in enumerate(diagram.branches))


def test_a_branch_that_ends_before_the_end_of_the_range_says_so() -> None:
    # At mu = 0 every x is a steady state: no single one is found there.
    system = textbook("cross", ("x",), lambda x, mu: (mu * (x - 0.3),), {"mu": float("nan")}, {"x": (-2.0, 2.0)})
    (branch,) = bifurcate(system, "mu", 0.0, 1.0, BifurcationOptions(values=2, cycles=False)).branches
    assert 0.0 < min(branch.values) < 0.05
    assert sorted(branch.ends) == ["no point found at the end of the range", "range"]
