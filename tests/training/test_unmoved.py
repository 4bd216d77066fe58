"""Learned constants by which what is fitted has no derivative: they are searched for, or are said to stay."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from gbspec.data import Trajectories, Trajectory
from gbspec.passes import with_switches
from gbspec.runs import last_search
from gbspec.training import TrainOptions, train
from gbspec.training.population.jumps import SPREAD, TimesOfJumps, _Tried, values_of
from gbspec.training.population.layout import Layout
from gbspec.training.recipe import Context, only_in_jumps
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.unmoved import unmoved, without_unmoved
from gbspec.training.stages import StageName
from tests.training.conftest import model_of
from tests.training.test_populations import NETWORK
from tests.training.test_populations import model_of as population_of

pytestmark = pytest.mark.usefixtures("quick_fits")

LATE = """model late
time t from 0
state x
learn k = 0.5 in [0.01, 5]
learn x0 = 2 in [0.1, 20] per trajectory ~ lognormal
learn lag = 0.4 in [0, 2]
learn e = 0.1 in [1e-3, 1]
x' = -k*x*if(t > lag, 1, 0)
initial x = x0
observe x noise normal(e)
"""
LAG = 1.1
ALONE = (
    LATE.replace(" per trajectory ~ lognormal", "").replace("learn e = 0.1 in [1e-3, 1]\n", "").replace("(e)", "(0.02)")
)
DISTURBED = ALONE.replace("observe x", "learn s = 0.1 > 0\ndiffusion x = s\nobserve x")
FAST = TrainOptions(workers=1, effort="low")


def measured(count: int) -> Trajectories:
    """Decays with the rate 0.8 that begin at `LAG`."""
    random, times = np.random.default_rng(3), np.arange(0.25, 4.1, 0.25)
    found = []
    for i in range(count):
        start = 2 * np.exp(0.3 * (i - (count - 1) / 2))
        values = start * np.exp(-0.8 * np.maximum(times - LAG, 0)) + 0.02 * random.standard_normal(len(times))
        x = values[:, None]
        found.append(Trajectory(str(i), 0.0, times, x, np.ones_like(x), np.full_like(x, np.nan), np.zeros(0)))
    return Trajectories(tuple(found), ("x",))


@pytest.mark.parametrize("bounds", ["[0, 2]", "[0.001, 1000]"])
def test_a_likelihood_searches_for_the_time_of_a_jump(tmp_path: Path, bounds: str) -> None:
    options = replace(FAST, stages="search; marginal likelihood; times of jumps", switches="off")
    run = train(model_of(LATE.replace("[0, 2]", bounds)), measured(2), options, tmp_path / "run")
    record, population = run.fit.constants["lag"], run.fit.population
    assert record.value == pytest.approx(LAG, abs=0.05) and record.interval is None
    assert run.fit.constants["k"].value == pytest.approx(0.8, rel=0.05)
    assert population is not None and population.parameters == 5
    assert population.minus2ll == pytest.approx(-137.624, abs=0.01), "on the lowest step of the likelihood"
    (stage,) = [one for one in run.fit.members[0].stages if one.name == StageName.JUMPS]
    assert stage.iterations < values_of(False), "it has settled"
    (said,) = [text for text in run.fit.warnings if "`lag`" in text]
    assert "no interval" in said and "the best of the values that were tried" in said and "`dose … lag lag`" in said


def test_a_likelihood_learns_the_time_of_a_jump_where_steps_end_there(tmp_path: Path) -> None:
    run = train(model_of(LATE), measured(2), FAST, tmp_path / "run")
    record, population = run.fit.constants["lag"], run.fit.population
    assert record.value == pytest.approx(LAG, abs=0.05) and record.interval is not None
    assert record.interval[0] < LAG < record.interval[1]
    assert population is not None and population.minus2ll < -138, "below the lowest value that steps across find"
    assert population.parameters == 5
    assert not any("`lag`" in text for text in run.fit.warnings)


def test_a_constant_that_no_step_moves_is_no_parameter(tmp_path: Path) -> None:
    options = replace(FAST, stages="marginal likelihood", switches="off")
    run = train(model_of(LATE), measured(2), options, tmp_path / "run")
    population = run.fit.population
    assert run.fit.constants["lag"].value == pytest.approx(0.4, rel=1e-9)
    assert population is not None and population.parameters == 4
    assert any("`lag` was not learned" in text and "its start, 0.4" in text for text in run.fit.warnings)


def test_least_squares_learn_the_time_of_a_jump(tmp_path: Path) -> None:
    run = train(model_of(ALONE), measured(1), replace(FAST, backend="native"), tmp_path / "run")
    record = run.fit.constants["lag"]
    assert record.value == pytest.approx(LAG, abs=0.05) and record.interval is not None
    assert record.interval[0] < LAG < record.interval[1]
    assert not any("`lag`" in text for text in run.fit.warnings)


def test_times_of_jumps_of_single_trajectories_have_intervals(tmp_path: Path) -> None:
    text = ALONE.replace("lag = 0.4 in [0, 2]", "lag = 0.4 in [0, 2] per trajectory")
    text = text.replace("x0 = 2 in [0.1, 20]", "x0 = 2 in [0.1, 20] per trajectory")
    run = train(model_of(text), measured(3), replace(FAST, backend="native"), tmp_path / "run")
    assert StageName.CUT in [stage.name for stage in run.fit.members[0].stages]
    own = run.fit.constants["lag"].per_trajectory
    assert own is not None and all(one.interval is not None for one in own.values())
    assert [one.value for one in own.values()] == pytest.approx([LAG] * 3, abs=0.05)
    assert not any("`lag`" in text for text in run.fit.warnings)
    search = last_search(run.fit.members[0].stages)  # a second look for own constants leads below what starts reached
    assert search is not None and search.near >= 0 and not any("-1" in text for text in run.fit.warnings)


@pytest.mark.parametrize(
    ("stages", "tried"),
    [
        (["search", "least squares"], True),
        (["marginal likelihood", "times of jumps"], True),
        (["search", "least squares", "cut steps"], False),
        (["least squares"], False),
    ],
)
def test_values_are_said_to_be_tried_where_they_were(stages: list[str], tried: bool) -> None:
    found = {"k": 0.8, "x0": 2.1, "lag": LAG}
    known = {"k": 0.1, "x0": 0.1, "lag": math.nan}
    result = MemberResult(0, 0.1, 0.1, {}, {}, {}, found, known, 1.0, [], np.zeros((1, 1)), ["0"])
    model = model_of(ALONE)
    (said,) = without_unmoved(result, cast(Context, SimpleNamespace(model=model, solved=model)), stages)
    assert "`lag` has no interval" in said and ("values that were tried" in said) == tried
    cut = SimpleNamespace(model=model, solved=with_switches(model).model)
    (said,) = without_unmoved(result, cast(Context, cut), stages)
    assert "the data do not show that place" in said and "no derivative" not in said


def test_a_fit_with_disturbances_says_that_a_constant_stayed(tmp_path: Path) -> None:
    run = train(model_of(DISTURBED), measured(1), FAST, tmp_path / "run")
    assert run.fit.constants["lag"].value == pytest.approx(0.4, rel=1e-9) and run.fit.constants["lag"].sd is None
    (said,) = [text for text in run.fit.warnings if "`lag`" in text]
    assert "`lag` was not learned" in said and "its start, 0.4" in said and "dose" not in said


def test_a_threshold_that_no_solution_passes_is_told(tmp_path: Path) -> None:
    text = ALONE.replace("0.4 in [0, 2]", "50 in [40, 60]").replace("if(t > lag, 1, 0)", "if(x > lag, 0.5, 1)")
    options = replace(FAST, backend="native", stages="least squares")
    run = train(model_of(text), measured(1), options, tmp_path / "run")
    assert run.fit.constants["lag"].value == pytest.approx(50, rel=1e-9) and run.fit.constants["lag"].interval is None
    assert any("`lag` was not learned" in text and "a start that solutions pass" in text for text in run.fit.warnings)


def test_what_no_data_can_show_is_told_once(tmp_path: Path) -> None:
    """Nothing is said of data that would help."""
    text = ALONE.replace("learn lag = 0.4 in [0, 2]", "learn z = 1 in [0, 2]").replace("if(t > lag, 1, 0)", "(1 + 0*z)")
    run = train(model_of(text), measured(1), replace(FAST, backend="native"), tmp_path / "run")
    assert run.fit.constants["z"].interval is None
    (said,) = [text for text in run.fit.warnings if "`z`" in text]
    assert "`z` cannot be learned from any data (GB402)" in said and "Data that show it" not in said


def test_constants_that_occur_only_where_values_jump() -> None:
    assert only_in_jumps(model_of(LATE)) == ("lag",)
    assert only_in_jumps(model_of(LATE.replace("1, 0)", "1, lag)"))) == ()
    assert only_in_jumps(model_of(ALONE.replace("if(t > lag, 1, 0)", "max(sign(t - lag), 0)"))) == ("lag",)


@pytest.mark.parametrize(
    "text",
    [
        LATE.replace("normal(e)", "student(e, lag)").replace("[0, 2]", "[0.1, 2]"),
        ALONE.replace("-k*x*", "-k*f(x)*") + "unknown f(x) <= lag\n",
        ALONE.replace("-k*x*", "-k*f(x)*") + "unknown f(x) = lag + nn\n",
        ALONE.replace("-k*x*", "-k*delay(x, 0.5)*") + "history x = lag*x0\n",
    ],
    ids=["noise", "contract", "postulate", "history"],
)
def test_constants_that_occur_elsewhere_too(text: str) -> None:
    assert only_in_jumps(model_of(text)) == ()


def test_values_are_tried_over_the_range_and_then_around_the_best() -> None:
    values = np.array([0.4])
    while not _Tried(values, (values - 0.77) ** 2).settled(SPREAD, 1e-5) and len(values) < values_of(False):
        values = np.append(values, _Tried(values, (values - 0.77) ** 2).next((0.0, 1.0), SPREAD))
    assert values[1] == pytest.approx(0.5 / SPREAD) and values[SPREAD] == pytest.approx(1 - 0.5 / SPREAD)
    assert np.abs(values - 0.77).min() < 2e-3 and len(values) < values_of(False)


def test_a_search_settles_on_a_step() -> None:
    values, losses = np.array([0.4, 0.1, 0.3, 0.5, 0.2, 0.6]), np.array([0.0, 2.0, 0.0, 0.0, 0.0, 1.0])
    more = np.linspace(0.8, 0.9, 3)
    far = _Tried(np.append(values, more), np.append(losses, more))
    assert far.settled(2, 0.0), "the first of several equal ones is the best"
    assert not _Tried(values, losses).settled(2, 0.0), "too few values"
    assert not _Tried(far.values, np.where(far.values == 0.5, 0.1, far.losses)).settled(2, 0.01)


@pytest.mark.parametrize(("bounds", "middle"), [("[0.01, 100]", 1), ("[-100, -0.01]", -1), ("[0, 4]", 2)])
def test_the_scale_of_a_search_is_that_of_the_range(bounds: str, middle: float) -> None:
    model = model_of(ALONE.replace("0.4 in [0, 2]", f"{middle} in {bounds}"))
    stage = object.__new__(TimesOfJumps)
    stage.layout, stage.near = cast(Layout, SimpleNamespace(each=model.learnables)), False
    place = [k.name for k in model.learnables].index("lag")
    low, high = stage._ends(place, middle)
    assert low < high and stage._value(place, (low + high) / 2) == pytest.approx(middle)
    assert [stage._value(place, each) for each in (low, high)] == pytest.approx(json.loads(bounds))


def test_an_effect_is_no_constant_that_stayed(tmp_path: Path) -> None:
    """It was counted out of the parameters, and said not to have been learned."""
    model = population_of(NETWORK, tmp_path)
    assert [k.name for k in model.learnables] == ["e"] and model.distributed
    assert unmoved(model, {"e": 0.0}, {}, ["marginal likelihood"]) == []
