"""Limit cycles against published numbers: periods, extremes, multipliers, and where branches of cycles end."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.collocation import product_eigenvalues
from gbspec.analysis.bifurcation.cycles import CycleBranch, CycleCurve, CycleOptions
from gbspec.analysis.bifurcation.hopf import analyse_hopf
from gbspec.analysis.bifurcation.limit_cycle import Cycle, others
from gbspec.analysis.bifurcation.settle import settle
from gbspec.analysis.systems.family import Family
from gbspec.analysis.systems.steady import steady_states
from gbspec.analysis.systems.system import System
from tests.analysis.textbook import (
    baltzis_fredrickson,
    brusselator,
    lorenz,
    morris_lecar,
    roessler,
    textbook,
    urp,
    van_der_pol,
)


def cycle_at(system: System, name: str, value: float, start: list[float]) -> Cycle:
    """The stable cycle at one value of the parameter, from the orbit to which the flow converges."""
    family = Family(system, name)
    orbit = settle(family, value, np.array(start))
    assert orbit is not None
    curve = CycleCurve(family, 0.9 * value, 1.1 * value)
    place = curve.at(orbit.period, orbit.states, value)
    assert place is not None
    return curve.cycle(place)


def born(system: System, name: str, low: float, high: float, hopf: tuple[float, np.ndarray]) -> CycleBranch:
    """The branch of cycles from a Hopf point."""
    family = Family(system, name)
    value, state = hopf
    return CycleCurve(family, low, high).from_hopf(state, value, analyse_hopf(family, state, value))


@pytest.mark.parametrize(
    ("Da", "period", "x1", "x2"),
    [
        (0.30, 3.00175874, 0.88760144, 3.46358205),
        (0.35, 2.41382022, 0.90470475, 3.47596125),
        (0.40, 2.09337028, 0.85741820, 2.80983466),
    ],
)
def test_cycles_of_the_reactor(Da: float, period: float, x1: float, x2: float) -> None:
    found = cycle_at(urp(), "Da", Da, [0.5, 1.0])
    assert found.period == pytest.approx(period, abs=1e-8)
    assert found.maximum == pytest.approx([x1, x2], abs=5e-8)
    assert found.stable


def test_the_trivial_multiplier_is_one_and_liouville_holds() -> None:
    found = cycle_at(urp(), "Da", 0.35, [0.5, 1.0])
    assert found.multipliers[0] == pytest.approx(1.0, abs=1e-8)
    # The product of the multipliers is exp of the integral of the divergence (Liouville).
    family = Family(urp(), "Da")
    trace = [np.trace(family.linear(x, 0.35)[1]) for x in found.states]
    area = np.sum(np.diff(found.times) * (np.array(trace[:-1]) + np.array(trace[1:])) / 2.0)
    area += (found.period - found.times[-1]) * (trace[-1] + trace[0]) / 2.0
    assert np.prod(found.multipliers).real == pytest.approx(np.exp(area), rel=2e-3)


def test_the_period_of_van_der_pol_at_5() -> None:
    # Tabulated to many digits for mu = 5: 11.6122306678 (e.g. Andersen and Geer, SIAM J. Appl. Math. 42, 1982: 11.612).
    found = cycle_at(van_der_pol(), "mu", 5.0, [2.0, 0.0])
    assert found.period == pytest.approx(11.6122306678, abs=1e-8)
    assert found.maximum[0] == pytest.approx(2.0215080, abs=1e-6)


def test_the_cycle_of_the_chemostat() -> None:
    found = cycle_at(baltzis_fredrickson(), "theta", 7.3 * 0.68, [40.0, 0.0, 0.3, 100.0, 1000.0, 0.7])
    assert found.period == pytest.approx(202.3407, abs=5e-5)
    assert found.multipliers[:3].real == pytest.approx([1.0, -0.0144, 0.0059], abs=5e-5)
    assert found.maximum == pytest.approx([78.41, 0.0, 0.3532, 208.69, 2119, 0.8218], rel=2e-4)
    assert found.minimum == pytest.approx([14.46, 0.0, 0.2819, 31.02, 395, 0.6572], rel=4e-4)


def test_the_branch_of_the_reactor_runs_from_hopf_to_hopf() -> None:
    branch = born(urp(), "Da", 0.2, 0.5, (0.2802749000, np.array([0.580178725, 1.595491495])))
    assert branch.end == "hopf"
    assert branch.found == ()
    assert branch.cycles[-1].value == pytest.approx(0.41954784, abs=2e-3)
    assert all(cycle.stable for cycle in branch.cycles)


def test_small_cycles_of_the_brusselator_follow_the_normal_form() -> None:
    branch = born(brusselator(), "B", 1.0, 3.0, (2.0, np.array([1.0, 2.0])))
    first, second = branch.cycles[0], branch.cycles[2]
    size = [float(np.ptp(cycle.states[:, 0])) for cycle in (first, second)]
    # Amplitude grows with the root of the distance from the Hopf point.
    assert (second.value - 2.0) / (first.value - 2.0) == pytest.approx((size[1] / size[0]) ** 2, rel=2e-2)
    assert first.period == pytest.approx(2.0 * np.pi, rel=1e-3)
    assert branch.end == "range"
    assert branch.cycles[-1].value == pytest.approx(3.0, abs=1e-12)


def test_folds_of_cycles_of_morris_lecar() -> None:
    # Ermentrout and Terman (2010), section 3.3: rest and oscillation are both stable from about 88.3 to 93.86 and from
    # 212.02 to about 217: the cycles born unstable turn stable at these folds.
    family = Family(morris_lecar(), "current")
    (state,) = (one.state for one in steady_states(morris_lecar(current=93.8576174)))
    branch = born(morris_lecar(), "current", 0.0, 300.0, (93.8576174, state))
    assert family.size == 2
    assert branch.end == "hopf"
    assert [kind for kind, _ in branch.found] == ["cycle_fold", "cycle_fold"]
    assert [cycle.value for _, cycle in branch.found] == pytest.approx([88.29, 216.9], abs=0.05)
    for _, cycle in branch.found:
        assert float(np.min(np.abs(others(cycle.multipliers) - 1.0))) < 1e-4
    assert not branch.cycles[0].stable
    assert any(cycle.stable for cycle in branch.cycles)


def test_the_cycles_of_lorenz_end_in_a_homoclinic_orbit() -> None:
    # Sparrow (1982): the unstable cycles of the Hopf point at 24.74 are born from a homoclinic orbit at r = 13.926...
    c = np.sqrt(8.0 / 3.0 * (470.0 / 19.0 - 1.0))
    branch = born(lorenz(), "r", 2.0, 30.0, (470.0 / 19.0, np.array([c, c, 470.0 / 19.0 - 1.0])))
    assert "homoclinic" in branch.end
    assert branch.cycles[-1].value == pytest.approx(13.926557, abs=1e-5)
    assert not any(cycle.stable for cycle in branch.cycles)


def test_period_doublings_of_roessler() -> None:
    # Roessler (Phys. Lett. A 57, 1976) with a = b = 0.2: the first period doubling is at c = 2.83 (Strogatz, 10.6).
    family = Family(roessler(), "c")
    orbit = settle(family, 2.5, np.array([1.0, 1.0, 0.5]))
    assert orbit is not None
    curve = CycleCurve(family, 2.0, 4.0)
    place = curve.at(orbit.period, orbit.states, 2.5)
    assert place is not None
    ahead, _ = curve.from_cycle(place)
    ((kind, once),) = ahead.found
    assert (kind, once.value) == ("period_doubling", pytest.approx(2.832, abs=2e-3))
    assert float(np.min(np.abs(once.multipliers + 1.0))) < 1e-6
    assert ahead.cycles[-1].value == pytest.approx(4.0)
    assert not ahead.cycles[-1].stable

    doubled = curve.from_doubling(ahead.doublings[0])
    first = doubled.cycles[0]
    assert doubled.start == "period doubling"
    assert once.value < first.value < once.value + 0.01
    assert first.period == pytest.approx(2.0 * once.period, rel=1e-3)
    assert first.stable
    # Beyond, the flow converges to the doubled cycle.
    (beyond,) = [cycle for cycle in doubled.cycles if 3.4 < cycle.value < 3.6][:1]
    settled = settle(family, beyond.value, beyond.states[0] + 0.05)
    assert settled is not None
    assert settled.period == pytest.approx(beyond.period, rel=1e-4)
    assert settled.states.max(axis=0) == pytest.approx(beyond.maximum, rel=1e-3)
    # They lose stability at the next doubling of the cascade.
    ((kind, twice),) = doubled.found
    assert kind == "period_doubling"
    assert [cycle.stable for cycle in doubled.cycles] == [cycle.value < twice.value for cycle in doubled.cycles]


@pytest.mark.parametrize(("doublings", "starts"), [(0, ["settled"]), (1, ["settled", "period doubling"])])
def test_a_diagram_follows_as_many_doublings_as_requested(doublings: int, starts: list[str]) -> None:
    options = BifurcationOptions(values=3, starts=8, cycle=CycleOptions(doublings=doublings))
    found = bifurcate(roessler(), "c", 2.5, 3.1, options)
    assert [branch.start for branch in found.cycles] == starts
    assert [one["start"] for one in found.to_json()["cycle_branches"]] == starts  # type: ignore[attr-defined, index]
    (point,) = found.of_kind("period_doubling")
    assert point.period is not None
    for cycle in found.cycles[-1].cycles:
        if doublings:
            assert cycle.stable
            assert cycle.period == pytest.approx(2.0 * point.period, rel=0.01)


def test_a_cycle_traversed_twice_is_counted_once() -> None:
    family = Family(roessler(), "c")
    orbit = settle(family, 2.5, np.array([1.0, 1.0, 0.5]))
    assert orbit is not None
    curve = CycleCurve(family, 2.0, 3.0)
    once = curve.at(orbit.period, orbit.states, 2.5)
    twice = curve.at(2.0 * orbit.period, np.vstack([orbit.states, orbit.states]), 2.5)
    assert once is not None
    assert twice is not None
    assert curve.cycle(twice).period == pytest.approx(curve.cycle(once).period, rel=1e-8)


def test_a_doubled_branch_followed_back_ends_at_the_doubling() -> None:
    family = Family(roessler(), "c")
    orbit = settle(family, 3.0, np.array([1.0, 1.0, 0.5]))
    assert orbit is not None
    curve = CycleCurve(family, 2.5, 3.1)
    place = curve.at(orbit.period, orbit.states, 3.0)
    assert place is not None
    _, back = curve.from_cycle(place)
    assert back.end == "period doubling"
    assert back.found == ()
    assert back.cycles[-1].value == pytest.approx(2.8324, abs=0.02)


def test_nothing_periodic_is_found_where_there_is_a_focus() -> None:
    assert settle(Family(urp(), "Da"), 0.22, np.array([0.4, 1.2])) is None


def test_options_bound_the_number_of_cycles() -> None:
    family = Family(brusselator(), "B")
    hopf = analyse_hopf(family, np.array([1.0, 2.0]), 2.0)
    branch = CycleCurve(family, 1.0, 4.0, CycleOptions(points=5)).from_hopf(np.array([1.0, 2.0]), 2.0, hopf)
    assert len(branch.cycles) == 5
    assert branch.end == "number of points"


def test_multipliers_of_very_different_size_are_both_found() -> None:
    generator = np.random.default_rng(1)
    frames = [np.linalg.qr(generator.normal(size=(2, 2)))[0] for _ in range(31)]
    frames[-1] = frames[0]
    steps = [b @ np.diag([10.0, 0.1]) @ a.T for a, b in itertools.pairwise(frames)]
    values = np.sort(np.abs(product_eigenvalues(np.array(steps))))
    assert np.log10(values) == pytest.approx([-30.0, 30.0], abs=1e-6)


def test_a_fold_of_cycles_is_drawn_on_the_cycles() -> None:
    options = BifurcationOptions(values=3, starts=8)
    found = bifurcate(morris_lecar(), "current", 80.0, 100.0, options)
    (fold,) = found.of_kind("cycle_fold")
    ((_, cycle),) = found.cycles[fold.branch].found
    assert found.drawn_at(fold) == pytest.approx(cycle.maximum)
    (hopf,) = found.of_kind("hopf")
    assert found.drawn_at(hopf) == pytest.approx(hopf.state)


def test_a_flow_that_blows_up_in_finite_time_settles_nowhere() -> None:
    """Bogdanov and Takens' normal form: outside of the unstable cycle x' = x^2 has no end but infinity."""
    states = {"x": (-3.0, 3.0), "y": (-3.0, 3.0)}
    system = textbook("bt", ("x", "y"), lambda x, y, m2: (y, -0.5 + m2 * y + x**2 + x * y), {"m2": 0.8}, states)
    assert settle(Family(system, "m2"), 0.8, np.array([0.8, 0.1])) is None
