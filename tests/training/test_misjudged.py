"""Constants that the curvature leaves open although the data hold them: two rates in turn that are fitted as equal."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import gbspec
from gbspec.runs import ConstantRecord, FitRecord, OwnRecord
from gbspec.training.population import Objective, PopulationResult, result_at
from gbspec.training.problem import Parameters
from gbspec.training.runs import misjudged, misjudged_own, populations
from gbspec.training.runs.constants import undetermined, undetermined_own
from gbspec.training.runs.deviance import held_by_data
from gbspec.training.runs.misjudged import misjudged_of_population
from gbspec.training.runs.summary import MemberResult

pytestmark = pytest.mark.usefixtures("quick_fits")

TURNS = """\
model turns "Two rates in turn"
time t from 0
state A in [0, 30]
state G in [0, 30]
learn ka = 0.3 in [0.02, 3]
learn ke = 0.3 in [0.02, 3]
learn A0 = 5 in [0.5, 50]
initial A = A0
initial G = 0
A' = -ka*A
G' = ka*A - ke*G
observe G
"""


def oscillating(path: Path, sizes: Sequence[float]) -> Path:
    """Values that ask for a damped oscillation: the nearest that two rates give is with both the same."""
    random, t = np.random.default_rng(3), np.arange(1.0, 25.0)
    lines = ["trajectory,t,G"]
    for i, size in enumerate(sizes):
        values = size * np.sin(0.12 * t) / 0.12 * np.exp(-0.3 * t) + 0.1 * random.standard_normal(len(t))
        lines += [f"{i},{a},{b:.4f}" for a, b in zip(t, values, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_rates_that_meet_are_not_called_undetermined(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text(TURNS)
    data = oscillating(tmp_path / "d.csv", [1.5])
    fit = gbspec.load(tmp_path / "m.gb").train(data, tmp_path / "run", effort="low").run.fit
    assert fit.constants["ka"].value == pytest.approx(fit.constants["ke"].value, rel=0.05)
    assert fit.constants["ka"].interval is None and fit.constants["ke"].interval is None
    (said,) = [text for text in fit.warnings if "`ka`" in text]
    assert "no interval: the curvature at the estimate" in said
    assert "`gbspec profile` gives intervals" in said
    assert "`ka` and `ke` have the same value" in said
    assert not any("not determined" in text or "come to rest" in text for text in fit.warnings), fit.warnings


def test_rates_of_single_trajectories_that_meet_are_not_called_undetermined(tmp_path: Path) -> None:
    own = re.sub(r"^(learn .*)$", r"\1 per trajectory", TURNS, flags=re.MULTILINE)
    (tmp_path / "m.gb").write_text(own)
    data = oscillating(tmp_path / "d.csv", [1.5, 2.5])
    fit = gbspec.load(tmp_path / "m.gb").train(data, tmp_path / "run", effort="low").run.fit
    each = fit.constants["ka"].per_trajectory
    assert each is not None and all(one.interval is None for one in each.values())
    (said,) = [text for text in fit.warnings if "`ka`" in text]
    assert "`ka` of `0`, `1`; `ke` of `0`, `1`" in said and "no interval: the curvature at the estimate" in said
    assert "for example with ka = " in said and "fit one trajectory alone, without `per trajectory`" in said


RATES_OF_THEIR_OWN = """\
model turns
time t from 0
state A in [0, 30]
state G in [0, 30]
learn ka = 1 in [0.01, 100] per trajectory
learn ke = 0.5 in [0.01, 100] per trajectory
learn g = 1 in [0.1, 10]
initial A = 10
initial G = 0
A' = -ka*A
G' = ka*A - ke*G
observe z = g*ke*G
"""
"""Two rates of each trajectory, and a constant of all of them."""


def sharper(path: Path) -> Path:
    """Curves of three trajectories that are sharper than two rates in turn allow."""
    random, t = np.random.default_rng(4), np.linspace(0.25, 10, 30)
    lines = ["trajectory,t,z"]
    for i, k in enumerate((0.4, 0.41, 0.42)):
        values = 10 * k**2.15 * t**1.15 * np.exp(-k * t) / 1.073 + 0.05 * random.standard_normal(len(t))
        lines += [f"{i},{a},{b:.4f}" for a, b in zip(t, values, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_rates_of_single_trajectories_beside_a_shared_constant_are_tested_too(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text(RATES_OF_THEIR_OWN)
    data = sharper(tmp_path / "d.csv")
    fit = gbspec.load(tmp_path / "m.gb").train(data, tmp_path / "run", effort="low").run.fit
    (said,) = [text for text in fit.warnings if "`ka`" in text]
    assert "`ka` of `0`, `1`, `2`; `ke` of `0`, `1`, `2` have no interval: the curvature" in said
    assert "profile" not in said  # of one trajectory alone, the shared constant would be another


def test_constants_of_single_trajectories_that_were_not_tested_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(misjudged_own, "MOST_TOGETHER", 2)
    (tmp_path / "m.gb").write_text(RATES_OF_THEIR_OWN)
    data = sharper(tmp_path / "d.csv")
    fit = gbspec.load(tmp_path / "m.gb").train(data, tmp_path / "run", effort="low", workers=1).run.fit
    held, untested = [text for text in fit.warnings if "`ka`" in text]
    assert "`ka` of `0`; `ke` of `0` have no interval" in held
    assert "`ka` of `1`, `2`; `ke` of `1`, `2` cover their bounds" in untested and "was not tested" in untested
    assert not any("do not determine" in text for text in fit.warnings), fit.warnings


def test_open_constants_of_single_trajectories_are_told(tmp_path: Path) -> None:
    """The second trajectory begins at 0, where no rate shows."""
    text = "model m\nstate x in [0, 2]\nlearn k = 1 in [0.01, 10] per trajectory\nx' = -k*x\nobserve x\n"
    (tmp_path / "m.gb").write_text(text)
    random, lines = np.random.default_rng(1), ["trajectory,t,x"]
    for label, size in (("a", 1.0), ("b", 0.0)):
        noise = 0.02 * random.standard_normal(8)
        lines += [f"{label},{t},{size * np.exp(-t / 2) + e * (t > 0):.4f}" for t, e in enumerate(noise)]
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    (said,) = [text for text in fit.warnings if "the 90 % interval of `k` of `b` covers its bounds" in text]
    assert "these data do not determine its value. A prior, a value" in said and said.endswith("what it acts on")


def test_a_prior_is_not_advised_where_there_is_one(tmp_path: Path) -> None:
    learned = "learn a in [0.01, 10] prior lognormal(1, 2) per trajectory\nlearn b = 1 in [0.01, 10] per trajectory\n"
    (tmp_path / "m.gb").write_text(f"model m\nstate x = 1\n{learned}x' = -a*x - b\nobserve x\n")
    model = gbspec.load(tmp_path / "m.gb").model
    each = {label: OwnRecord(1.0, 3.0, (0.01, 10.0)) for label in "TU"}
    known = {k: ConstantRecord(1.0, None, None, 1.0, (1.0,), each) for k in "ab"}
    (said,) = undetermined_own(model, {"a": known["a"]}, {("a", "T"), ("a", "U")})
    assert "these data do not determine their values. A narrower prior, a value" in said
    open_ones, untested = undetermined_own(model, known, {("a", "T")})
    assert open_ones.startswith("the 90 % interval of `a` of `T` covers its bounds") and "A narrower prior" in open_ones
    assert untested.startswith("the 90 % intervals of `a` of `U`; `b` of `T`, `U` cover") and ". A prior" in untested


@pytest.mark.parametrize(("labels", "said"), [("A", "fit without `per"), ("AB", "fit one trajectory alone, without")])
def test_intervals_of_constants_per_trajectory_are_offered_by_a_profile_that_has_them(labels: str, said: str) -> None:
    result = cast(MemberResult, SimpleNamespace(labels=list(labels)))
    assert said in misjudged_own._profiled(result, cast(Parameters, SimpleNamespace(n_shared=0)))


Asked = tuple[MemberResult, Objective, PopulationResult]


def population_of(path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[FitRecord, Asked]:
    """A fit of rates that meet, of several trajectories; what was asked at its end about open constants."""
    asked: list[Asked] = []

    def recorded(result: MemberResult, objective: Objective, found: PopulationResult) -> list[str]:
        asked.append((replace(result, sd=dict(result.sd)), objective, found))
        return misjudged_of_population(result, objective, found)

    monkeypatch.setattr(populations, "misjudged_of_population", recorded)
    text = TURNS.replace("in [0.5, 50]", "in [0.5, 50] per trajectory ~ lognormal")
    (path / "m.gb").write_text(text.replace("observe G", "learn s = 0.1 in [0.01, 1]\nobserve G noise normal(s)"))
    data = oscillating(path / "d.csv", [1.5, 2.5, 1.0, 2.0])
    fit = gbspec.load(path / "m.gb").train(data, path / "run", effort="low", workers=1).run.fit
    return fit, asked[-1]


def test_rates_of_a_population_that_meet_are_not_called_undetermined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit, (result, objective, found) = population_of(tmp_path, monkeypatch)
    assert fit.constants["ka"].interval is None and fit.constants["s"].interval is not None
    assert any("`ka`, `ke` and `A0` have no interval" in text for text in fit.warnings), fit.warnings
    assert any("`gbspec profile` gives intervals" in text for text in fit.warnings), fit.warnings
    assert not any("not determined" in text for text in fit.warnings), fit.warnings

    # Its cost is a number of evaluations. Where these end before an answer, constants stay open.
    count = _counted(objective, monkeypatch)
    again = replace(result, sd=dict(result.sd))
    (said,) = misjudged_of_population(again, objective, found)
    assert "lower" not in said and again.misjudged == {"ka", "ke", "A0"} and len(count) <= 80
    count.clear()
    monkeypatch.setattr(misjudged, "EVALUATIONS", 20)
    fewer = replace(result, sd=dict(result.sd))
    misjudged_of_population(fewer, objective, found)
    assert len(count) == 20 and fewer.misjudged == {"ka"} and np.isfinite(fewer.sd["A0"])
    # From a point that is no minimum, holding a constant and fitting the others finds one.
    monkeypatch.setattr(misjudged, "EVALUATIONS", 240)
    moved = found.point.u + np.array([0.0, 0.0, 0.0, 0.3, 0.0])
    off = result_at(objective, found.point.weights, moved, found.point.z, found.ridge)
    for name in ("ka", "ke"):
        again = replace(result, sd=result.sd | {"ka": 0.01, "ke": 0.01, "A0": 0.01, name: 1e3})
        said = misjudged_of_population(again, objective, off)[-1]
        told = re.match(
            rf"there is a lower minimum: with {name} = \S+, and all else refitted, -2 log L is (\S+) ", said
        )
        assert told is not None and f"begin there (`learn {name} = " in said, said
        rise = off.point.objective - found.point.objective
        assert 0.1 < float(told[1]) <= 1.05 * rise


def _counted(objective: Objective, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The values, gradients and curvatures that are asked for from now on."""
    count: list[str] = []

    def counting(name: str, whole: Callable[..., Any]) -> Callable[..., Any]:
        def asked(*given: Any, **more: Any) -> Any:
            count.append(name)
            return whole(*given, **more)

        return asked

    for name in ("at", "gradient", "curvature"):
        monkeypatch.setattr(objective, name, counting(name, getattr(objective, name)))
    return count


@pytest.mark.parametrize(("sharp", "held"), [(1.0, True), (0.01, False)])
def test_a_constant_is_held_where_the_deviance_rises_on_the_way_to_its_bounds(
    tmp_path: Path, sharp: float, held: bool
) -> None:
    (tmp_path / "m.gb").write_text("model m\nstate x = 1\nlearn k = 50 in [0.01, 100]\nx' = -k\nobserve x\n")
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables
    found = held_by_data(learnable, 1.0, lambda value: 10 * sharp * np.log(value) ** 2, 2.7)
    assert (found is not None) is held
    if found is not None:
        assert found.worse == pytest.approx((0.01**0.12,))  # at 0.05 it is not yet clear; what is above changes nothing


def test_a_constant_that_the_data_keep_from_one_bound_alone_may_be_anywhere_else(tmp_path: Path) -> None:
    """Up to 95 % of the way to its upper bound, and down to the lower one, is nearly all of its range."""
    (tmp_path / "m.gb").write_text("model m\nstate x = 1\nlearn k = 5 in [0, 10]\nx' = -k\nobserve x\n")
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables
    assert held_by_data(learnable, 5.0, lambda value: 9.0 if value > 9.6 else 0.0, 2.7) is None
    found = held_by_data(learnable, 5.0, lambda value: 9.0 if value > 8 else -np.inf, 2.7)
    assert found is not None and found.worse == pytest.approx((8.75,))


def test_a_constant_is_moved_no_further_than_what_decides(tmp_path: Path) -> None:
    """Nine tenths of a range are as good as all of it."""
    (tmp_path / "m.gb").write_text("model m\nstate x = 1\nlearn k = 5 in [0, 10]\nx' = -k\nobserve x\n")
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables
    asked: list[float] = []
    assert held_by_data(learnable, 5.0, lambda value: float(asked.append(value) or 0.0), 2.7) is None
    assert asked == pytest.approx([4.75, 4.4, 3.75, 2.5, 1.25, 0.25, 5.25, 5.6, 6.25, 7.5, 8.75])
    asked.clear()
    assert held_by_data(learnable, 5.0, lambda value: 9.0 if asked.append(value) or value < 4 else 0.0, 2.7) is not None
    assert asked == pytest.approx([4.75, 4.4, 3.75])


def test_a_range_whose_ends_are_less_than_two_decades_apart_is_walked_too(tmp_path: Path) -> None:
    """A quarter of the way from 0.07 to 1 is 0.3, where a fit may have no solution: nearer places tell before."""
    (tmp_path / "m.gb").write_text("model m\nstate x = 1\nlearn k = 0.1 in [0.02, 1]\nx' = -k\nobserve x\n")
    (learnable,) = gbspec.load(tmp_path / "m.gb").model.learnables

    def rise(value: float) -> float:
        return -np.inf if value > 0.25 else 7 * np.log(value / 0.07) ** 2

    found = held_by_data(learnable, 0.07, rise, 2.7)
    assert found is not None and max(found.worse) < 0.2


LAGGED = """\
model lagged
time t
input T held
state Te in [-10, 40]
learn tau = 1 in [0.1, 20]
unknown use(Te) by spline(6)
Te' = (T - Te)/tau
observe y = use
"""


def following(path: Path) -> Path:
    """A quantity that follows the temperature of the row before: a lag shorter than the time between rows."""
    random, before, now, lines = np.random.default_rng(0), 15.0, 15.0, ["t,T,y"]
    for k in range(120):
        now = 15 + 0.6 * (now - 15) + 6 * random.standard_normal()
        lines.append(f"{k},{now:.3f},{0.02 * (before - 15) ** 2 + 2 * random.standard_normal():.4f}")
        before = now
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_constant_beside_an_unknown_function_that_the_data_hold_is_not_called_undetermined(tmp_path: Path) -> None:
    """Near its lower bound the solution no longer depends on it, so that the curvature leaves it open to 20."""
    (tmp_path / "m.gb").write_text(LAGGED)
    data = following(tmp_path / "d.csv")
    fit = gbspec.load(tmp_path / "m.gb").train(data, tmp_path / "run", effort="low").run.fit
    assert fit.constants["tau"].value < 0.3
    assert not any("not determined" in text for text in fit.warnings), fit.warnings
    assert any("`tau` has no interval: the curvature" in text for text in fit.warnings), fit.warnings


def test_a_constant_that_only_the_curvature_leaves_open_is_not_called_undetermined(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text("model m\nstate x = 1\nlearn k = 1 in [0.1, 20]\nx' = -k*x\nobserve x\n")
    model = gbspec.load(tmp_path / "m.gb").model
    known = {"k": ConstantRecord(0.12, 0.6, (0.1, 20.0), 1.0, (0.12,))}
    (said,) = undetermined(model, known)
    assert "`k` is not determined by these data" in said
    (said,) = undetermined(model, known, untested=frozenset("k"))
    assert "whether the data do is not known: `gbspec profile` tells" in said and "not determined" not in said
