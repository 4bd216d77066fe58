"""Known forms whose data are far apart: the step is halved until its error no longer shows in the constants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.backends.module import load_module
from gbspec.data import Trajectories, Trajectory
from gbspec.diagnostics import ComputationError
from gbspec.training import TrainOptions, train
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, State
from gbspec.training.progress import Update
from gbspec.training.recipe import finer, step_fraction
from gbspec.training.recipe.context import build_context
from gbspec.training.recipe.finer import FinerStep, continuing, step_shows
from gbspec.training.recipe.planned import Reached
from gbspec.training.runs.summary import only_at_its_step
from gbspec.training.stages import StageName
from tests.training.conftest import Recorder, model_of

ABSORPTION = """
model absorption
time t
state A
state C
learn ka = 0.3 in [0.01, 10]
learn ke = 0.1 in [0.001, 1]
A' = -ka*A
C' = ka*A - ke*C
initial A = 10
initial C = 0
observe C
"""
KA, KE = 0.82, 0.05


def absorbed(times: list[float]) -> Trajectories:
    """The exact concentrations at some times."""
    t = np.array(times)
    values = (10 * KA / (KA - KE) * (np.exp(-KE * t) - np.exp(-KA * t)))[:, None]
    item = Trajectory("1", 0.0, t, values, np.ones_like(values), np.full_like(values, np.nan), np.zeros(0))
    return Trajectories((item,), ("C",))


pytestmark = pytest.mark.usefixtures("quick_fits")
SPARSE = absorbed([0.0, 2.0, 14.0, 26.0, 38.0, 50.0])


def test_a_long_default_step_does_not_bias_a_fast_constant(tmp_path: Path) -> None:
    run = train(model_of(ABSORPTION), SPARSE, TrainOptions(workers=1, effort="low"), tmp_path / "run")
    names = [stage.name for stage in run.fit.members[0].stages]
    assert 1 <= names.count("finer step") <= 3
    assert run.fit.constants["ka"].value == pytest.approx(KA, rel=2e-3)
    assert run.fit.constants["ke"].value == pytest.approx(KE, rel=2e-4)
    assert run.member().info["max_step"] == 2.0 * 0.5 ** names.count("finer step")


class StopsOnTheWay(Recorder):
    """Interrupts the first finer step after its first iteration."""

    def update(self, update: Update) -> None:
        if (update.stage, update.iteration) == ("finer step", 1):
            raise KeyboardInterrupt


def test_an_interrupted_finer_step_goes_on_at_its_step(tmp_path: Path) -> None:
    model, options = model_of(ABSORPTION), TrainOptions(workers=1, effort="low")
    whole = train(model, SPARSE, options, tmp_path / "whole").fit
    with pytest.raises(KeyboardInterrupt):
        train(model, SPARSE, options, tmp_path / "run", StopsOnTheWay())
    resumed = train(model, SPARSE, replace(options, resume=True), tmp_path / "run").fit
    assert next(one.iterations for one in whole.members[0].stages if one.name == "finer step") > 1
    assert [one.iterations for one in resumed.members[0].stages] == [one.iterations for one in whole.members[0].stages]
    assert resumed.constants == whole.constants


def test_a_step_that_was_given_stays(tmp_path: Path) -> None:
    run = train(model_of(ABSORPTION), SPARSE, TrainOptions(workers=1, effort="low", max_step=2.0), tmp_path / "run")
    assert "finer step" not in [stage.name for stage in run.fit.members[0].stages]
    assert run.member().info["max_step"] == 2.0
    assert abs(run.fit.constants["ka"].value / KA - 1) > 0.01, "the error that the user's step has"


def test_residuals_of_many_stated_deviations_are_no_reason_to_keep_a_long_step(tmp_path: Path) -> None:
    """At the first step the residuals of C are a hundred times its noise, and its solution is near the data."""
    (item,) = SPARSE.items
    values = np.hstack([10 * np.exp(-KA * item.times)[:, None], item.values])
    both = replace(item, values=values, counts=np.ones((6, 2)), sd=np.full((6, 2), np.nan))
    model = model_of(ABSORPTION.replace("observe C", "observe A noise normal(1)\nobserve C noise normal(1e-4)"))
    run = train(model, Trajectories((both,), ("A", "C")), TrainOptions(workers=1, effort="low"), tmp_path / "run")
    assert [stage.name for stage in run.fit.members[0].stages].count("finer step") == 3
    assert run.fit.constants["ka"].value == pytest.approx(KA, rel=2e-3)
    assert not [warning for warning in run.fit.warnings if "half the solver's step" in warning]


def test_each_finer_stage_halves_the_step() -> None:
    assert [step_fraction(["search", *["finer step"] * n]) for n in range(4)] == [1.0, 0.5, 0.25, 0.125]


HIDDEN = """
model elimination
time t
condition D in [1, 20]
state A
state C in [0, 15]
learn ka = 0.3 in [0.01, 10]
unknown out(C in [0, 15]) = 0.05*C*nn by mlp(4)
A' = -ka*A
C' = ka*A - out
initial A = D
initial C = 0
observe C
"""


def doses() -> Trajectories:
    """Six doses of the same substance, without noise."""
    (one,) = SPARSE.items
    items = [
        replace(one, label=str(i), values=one.values * dose / 10, condition=np.array([dose]))
        for i, dose in enumerate((2.0, 4.0, 7.0, 10.0, 13.0, 16.0))
    ]
    return replace(SPARSE, items=tuple(items))


def test_a_model_with_a_network_is_fitted_at_a_step_that_does_not_show(tmp_path: Path) -> None:
    recorder = Recorder()
    run = train(model_of(HIDDEN), doses(), TrainOptions(workers=1), tmp_path / "run", recorder)
    (member,) = run.fit.members
    finer = [stage for stage in member.stages if stage.name == "finer step"]
    assert 1 <= len(finer) <= 4
    assert "half step" in [stage.name for stage in member.stages]
    shown = [f"largest step {0.5**n:.3g}, since the error of twice this step showed" for n in range(1, len(finer) + 1)]
    assert [stage.remark for stage in finer] == shown
    assert list(dict.fromkeys(u.remark for u in recorder.updates if u.stage == "finer step")) == shown
    assert run.member().info["max_step"] == 0.5 ** len(finer)
    assert run.fit.constants["ka"].value == pytest.approx(KA, rel=0.01)


def test_the_step_of_a_network_that_was_given_stays(tmp_path: Path) -> None:
    run = train(model_of(HIDDEN), doses(), TrainOptions(workers=1, max_step=2.0), tmp_path / "run")
    assert "finer step" not in [stage.name for stage in run.fit.members[0].stages]


@pytest.mark.parametrize("end", [np.inf, 1e290])
def test_solutions_that_blow_up_at_half_the_step_show(end: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such a fit follows the data by the error of its steps; to pass it over would be to keep it."""
    context = build_context(model_of(ABSORPTION), load_module(model_of(ABSORPTION)), SPARSE, TrainOptions(), 0)
    parameters = context.parameters({})
    now, half = (context.engine(parameters, 0.0, fraction) for fraction in (1.0, 0.5))
    theta = np.zeros(parameters.size)
    good = np.zeros(now.problem.seen.shape)
    tables = {id(now): good, id(half): np.where(np.arange(len(good)) < len(good) - 1, 0.0, end)[:, None]}
    monkeypatch.setattr(finer, "residual_table", lambda engine, vector: tables[id(engine)])
    assert step_shows(now, half, theta, constants=False)
    tables[id(half)] = good
    assert not step_shows(now, half, theta, constants=False)


@pytest.mark.parametrize(("limit", "begun"), [(0.0, 0.0), (1.0, 1.0), (2.0, None)])
def test_a_finer_step_that_cannot_be_solved_begins_elsewhere(
    limit: float, begun: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What cannot be solved there either is no beginning: the fit keeps its step, and its warning."""
    monkeypatch.setattr(finer, "astray", lambda engine, theta: np.array([[theta[0] < limit]]))
    monkeypatch.setattr(LevenbergMarquardt, "begin", lambda self, theta: {"theta": theta})
    of = LevenbergMarquardt("any", 1, lambda iteration: None, LevenbergOptions())  # type: ignore[arg-type, return-value]
    stage = FinerStep(of, "largest step 1", lambda theta: theta + 1)
    if begun is None:
        with pytest.raises(ComputationError, match="half the solver's step"):
            stage.begin(np.zeros(2))
    else:
        assert np.array_equal(stage.begin(np.zeros(2))["theta"], np.full(2, begun))


@pytest.mark.parametrize(("enough", "steps"), [(0.0, 1), (1.0, 0)])
def test_a_fit_with_small_residuals_at_the_finer_step_too_rests(
    enough: float, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No Jacobian is taken then; at fine steps it is most of the time of a fit of exact data."""
    context = build_context(model_of(ABSORPTION), load_module(model_of(ABSORPTION)), SPARSE, TrainOptions(), 0)
    engine, taken = context.engine(context.parameters({}), 0.0, 0.5), []
    of = LevenbergMarquardt(StageName.FINER, 1, lambda iteration: engine, LevenbergOptions(enough=enough))

    def step(self: LevenbergMarquardt, state: State, iteration: int) -> Outcome:
        taken.append(iteration)
        return Outcome(state, 0.0, True)

    monkeypatch.setattr(LevenbergMarquardt, "step", step)
    theta = np.zeros(engine.parameters.size)
    outcome = FinerStep(of, "largest step 1").step(of.begin(theta), 0)
    assert len(taken) == steps
    assert outcome.done
    assert outcome.remark == "largest step 1"
    assert np.array_equal(outcome.state["theta"], theta)


def test_a_stage_that_continues_a_fit_begins_with_the_ridge_where_its_evidence_stood() -> None:
    """From the first small ridge a fit of noisy data would follow the noise again, and need many iterations to rest."""
    options, reached = LevenbergOptions(ridge=1e-6, evidence=True), Reached(np.zeros(1), ridge=2e-3)
    assert continuing(options, reached).ridge == 2e-3
    assert continuing(options, replace(reached, ridge=0.0)).ridge == 1e-6
    assert continuing(replace(options, evidence=False), reached).ridge == 1e-6


@pytest.mark.parametrize(("ended", "begins"), [(3e-5, 3e-5), (0.0, finer.STEADY), (1e9, finer.STEADY)])
def test_a_stage_that_continues_an_exact_fit_begins_with_the_damping_where_that_ended(
    ended: float, begins: float
) -> None:
    """Each larger one that is tried on the way costs as much as an iteration; that of a failed search is no guide."""
    assert continuing(LevenbergOptions(), Reached(np.zeros(1), damping=ended)).damping == begins
    assert continuing(LevenbergOptions(ridge=1e-6), Reached(np.zeros(1), damping=ended)).damping == finer.STEADY


BLOWS_UP = """
model blows_up
time t
state x
learn k = 2 in [0.1, 10]
x' = k*exp(x)
initial x = 0
observe x
"""


@pytest.mark.parametrize("k", [0.5, 2.0])
def test_a_solution_that_only_a_long_step_keeps_finite_is_told(k: float) -> None:
    """x blows up at t = 1/k; one step of Runge and Kutta passes over that, two do not. The data are those of one."""
    t, model = np.array([0.0, 1.0]), model_of(BLOWS_UP)
    end = load_module(model)({"constants": np.array([k])}).simulate([0.0], t, max_step=1.0)[1:].numpy()
    item = Trajectory("1", 0.0, t, np.vstack([[0.0], end]), np.ones((2, 1)), np.full((2, 1), np.nan), np.zeros(0))
    context = build_context(model, load_module(model), Trajectories((item,), ("x",)), TrainOptions(max_step=1.0), 0)
    parameters = context.parameters({})
    theta = parameters.vector({}, np.array([k]))
    told = only_at_its_step(context, parameters, theta, 1.0, [])
    assert bool(told) == (k == 2.0)
    assert not only_at_its_step(context, parameters, theta, 1.0, ["1"])
    assert all("half the solver's step (0.5) solutions of `1` blow up or" in text for text in told)
