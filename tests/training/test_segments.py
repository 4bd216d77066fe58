"""Segments of trajectories, the stage of growing horizons, and curves of unmeasured states by differentiation."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.backends.module import load_module
from gbspec.data import DoseEvents, Signal, Trajectories, Trajectory
from gbspec.diagnostics import ComputationError
from gbspec.ir import Model
from gbspec.training import TrainOptions, train
from gbspec.training.engines import objective, predicted, residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, State
from gbspec.training.options import Backend
from gbspec.training.recipe import growing, whole
from gbspec.training.recipe.context import Context, build_context
from gbspec.training.recipe.growing import GrowingHorizons
from gbspec.training.recipe.planned import Reached
from gbspec.training.recipe.planning import plan
from gbspec.training.recipe.segments import Segments, cut, divisible, horizons
from gbspec.training.stages import StageName
from gbspec.training.starts.differentiation import determined, slopes, with_derived
from gbspec.training.starts.splines import fit_curves
from tests.training.conftest import model_of
from tests.training.reference import whole_jacobian

DRIVE = """
model drive
time t
state q in [-3, 3]
state v
input F held
unknown friction(v in [-3, 3]) by mlp(4)
learn m = 1 in [0.1, 10]
q' = v
v' = (F - friction)/m
observe q
"""


def drive_data(rows: int = 120, span: float = 12.0) -> Trajectories:
    """Positions of a mass 2 with friction v + v|v|/2 under a force that changes every second, without noise."""
    inner = 20
    t = np.linspace(0, span, rows)
    levels = np.random.default_rng(3).uniform(-2, 2, int(span) + 1)
    q, v, out = 0.0, 0.0, [0.0]
    for a, b in pairwise(t):
        h = (b - a) / inner
        for i in range(inner):
            force = levels[int(min(a + (i + 0.5) * h, span))]
            middle = v + h / 2 * (force - v - v * abs(v) / 2) / 2
            q, v = q + h * middle, v + h * (force - middle - middle * abs(middle) / 2) / 2
        out.append(q)
    values = np.array(out)[:, None]
    signal = Signal(np.arange(len(levels), dtype=float), levels)
    item = Trajectory("1", 0.0, t, values, np.ones_like(values), np.full_like(values, np.nan), np.zeros(0), (signal,))
    return Trajectories((item,), ("q",))


def with_speeds(data: Trajectories) -> Trajectories:
    """The same trajectory with speeds, by differences of its positions."""
    (item,) = data.items
    both = replace(item, **{name: np.hstack([getattr(item, name)] * 2) for name in ("values", "counts", "sd")})
    both.values[:, 1] = np.gradient(both.values[:, 0], item.times)
    return Trajectories((both,), ("q", "v"))


def context_of(model: Model, data: Trajectories, backend: Backend = "torch") -> Context:
    return build_context(model, load_module(model), data, TrainOptions(backend=backend), 0)


def test_segments_share_their_end_rows_and_cover_everything() -> None:
    data, owner, first = cut(drive_data(), 25, everywhere=True)
    assert owner.tolist() == [0] * 5
    assert first.tolist() == [0, 24, 48, 71, 95]
    ends = [(item.start, item.end) for item in data.items]
    assert all(a[1] == b[0] for a, b in pairwise(ends))
    assert ends[-1][1] == 12.0
    only, owner, first = cut(drive_data(), 25, everywhere=False)
    assert (len(only), owner.tolist(), first.tolist()) == (1, [0], [0])


def test_later_segments_have_only_their_own_doses() -> None:
    data = drive_data()
    item = replace(data.items[0], doses=(DoseEvents(np.array([0.0, 6.0]), np.array([1.0, 2.0])),))
    parts, _, first = cut(replace(data, items=(item,)), 60, everywhere=True)
    assert first.tolist() == [0, 60]
    assert [part.doses[0].amounts.tolist() for part in parts.items] == [[1.0, 2.0], []]


def test_a_model_with_delays_has_only_beginnings() -> None:
    assert divisible(model_of(DRIVE))
    assert not divisible(model_of(DRIVE.replace("q' = v", "q' = delay(v, 0.5)")))


@pytest.mark.parametrize("given", ["initial v = 0", "initial v = 0.2*m", "initial steady", "initial v steady"])
def test_later_segments_do_not_start_at_values_that_the_model_gives(given: str) -> None:
    text = DRIVE.replace("state v", "state v in [-3, 3]").replace("friction)", "friction - q - 5*v)")
    text = text.replace("observe q", f"{given}\nobserve q")
    context = context_of(model_of(text), drive_data())
    whole = context.parameters(context.module.weights, released=True)
    theta = whole.vector(context.module.weights)
    states = Segments.of(context, whole, 200).states(theta)
    many = Segments.of(context, whole, 25)
    vector = many.vector(theta, states)
    assert np.allclose(many.states(vector)[0], states[0], atol=1e-10)
    direction = np.random.default_rng(0).standard_normal(len(vector)) * many.parameters.free
    dense = whole_jacobian(objective.linearise(many.engine, vector), many.parameters).numpy()
    ahead, behind = (residual_vector(many.engine, vector + step * direction) for step in (1e-6, -1e-6))
    assert np.allclose(dense @ direction, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-6)


def test_horizons_grow_from_a_visible_change_to_whole_trajectories() -> None:
    context = context_of(model_of(DRIVE), drive_data())
    found = horizons(context)
    assert found == (8, 20, 50, 119)
    assert horizons(context_of(model_of(DRIVE), drive_data(6, 1.0))) == ()


def test_the_vector_of_segments_is_the_same_solution() -> None:
    context = context_of(model_of(DRIVE), drive_data())
    whole = context.parameters(context.module.weights, released=True)
    theta = whole.vector(context.module.weights)
    one = Segments.of(context, whole, 200)
    states = one.states(one.vector(theta, None))
    assert [table.shape for table in states] == [(120, 2)]
    many = Segments.of(context, whole, 25)
    vector = many.vector(theta, states)
    assert np.allclose(many.states(vector)[0], states[0], atol=1e-10)
    assert np.allclose(many.merged(vector), one.merged(one.vector(theta, states)), atol=1e-12)


def test_a_velocity_is_the_derivative_of_a_position() -> None:
    model, data = model_of(DRIVE), drive_data()
    curves = fit_curves(model, data)
    assert determined(model, curves) == (0, 1)
    velocity = with_derived(model, load_module(model).random(0), data, curves).items[0][1]
    assert velocity is not None
    t = np.linspace(1, 11, 50)
    assert np.allclose(velocity.value(t), np.interp(t, data.items[0].times, np.gradient(
        data.items[0].values[:, 0], data.items[0].times)), atol=0.03)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (DRIVE.replace("q' = v", "q' = m*v"), "the factor is learned"),
        (DRIVE.replace("q' = v", "q' = v + friction"), "it contains an unknown function"),
        (DRIVE.replace("q' = v", "q' = v^2"), "it is not linear"),
    ],
)
def test_other_balances_determine_no_state(text: str, why: str) -> None:
    model = model_of(text)
    assert determined(model, fit_curves(model, drive_data())) is None, why


def test_slopes_of_noisy_values() -> None:
    t = np.linspace(0, 20, 400)
    y = np.sin(t) + 0.02 * np.random.default_rng(0).standard_normal(400)
    error = np.sqrt(np.mean((slopes(t, y) - np.cos(t)) ** 2))
    assert error < 0.05 < 0.2 < np.sqrt(np.mean((np.gradient(y, t) - np.cos(t)) ** 2))


@pytest.mark.usefixtures("quick_fits")
def test_growing_horizons_find_a_law_that_intervals_do_not_show() -> None:
    model, data = model_of(DRIVE), drive_data()
    context = context_of(model, data, "auto")
    fixed = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    whole = context.parameters(fixed, released=True)
    theta = whole.vector(context.module.weights)
    stage = GrowingHorizons(context, whole, [theta], "normal")
    state, iteration, losses = stage.begin(theta), 0, []
    while iteration < stage.total:
        outcome: Outcome = stage.step(state, iteration)
        state, iteration = outcome.state, iteration + 1
        losses.append(outcome.loss)
        if outcome.done:
            break
    assert outcome.done
    engine = context.engine(whole, 0.0)
    before, after = (float(np.mean(residual_vector(engine, at) ** 2)) for at in (theta, state["theta"]))
    assert after < 0.01 < before, "R² of whole solutions above 0.99"


def test_further_attempts_limit_large_residuals_before_least_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    context = context_of(model_of(DRIVE), drive_data(24, 2.4))
    fixed = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    whole, kept = context.parameters(fixed, released=True), context.parameters(fixed)
    theta = whole.vector(context.module.weights)
    (planned,) = [one for one in plan(context, kept) if one.name is StageName.HORIZONS]
    stage = planned.make(Reached(theta, {StageName.WARM_START: 2 * theta}))
    assert isinstance(stage, GrowingHorizons)
    first, again, second, *_ = stage.starts
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second)
    seen: list[bool] = []

    def step(self: LevenbergMarquardt, state: State, iteration: int) -> Outcome:
        """Rests in its second iteration."""
        seen.append(self.options.robust)
        return Outcome(state, 1.0, len(seen) % 2 == 0)

    monkeypatch.setattr(LevenbergMarquardt, "step", step)
    monkeypatch.setattr(growing, "horizons", lambda context, growth: (20,))
    monkeypatch.setattr(GrowingHorizons, "losses", lambda self, theta: (0.1, 0.5))
    GrowingHorizons(context, whole, [theta, theta], "normal").run(theta)
    assert seen == [False, False, True, True, False, False], "least squares follow"


@pytest.mark.usefixtures("quick_fits")
def test_noise_alone_is_not_taken_for_a_disturbance(tmp_path: Path) -> None:
    """Short segments have initial states of their own, which follow a part of the noise; whole solutions cannot."""
    data = drive_data(1000, 40.0)
    (exact,) = data.items
    noise = 0.1 * np.random.default_rng(1).standard_normal(exact.values.shape)
    noisy = replace(data, items=(replace(exact, values=exact.values + noise),))
    run = train(model_of(DRIVE), noisy, TrainOptions(workers=1, seed=1), tmp_path / "run")
    assert StageName.HORIZONS.value in [stage.name for stage in run.fit.members[0].stages]
    assert not [warning for warning in run.fit.warnings if "disturbed" in warning]


@pytest.mark.usefixtures("quick_fits")
def test_a_drive_is_trained_with_default_options(tmp_path: Path) -> None:
    run = train(model_of(DRIVE), drive_data(), TrainOptions(workers=1, seed=1), tmp_path / "run")
    (member,) = run.fit.members
    assert run.fit.constants["m"].value == pytest.approx(2.0, rel=0.1)
    found = member.channels["q"]
    assert found.r2 is not None and found.naive is not None
    assert found.r2 > 0.9999 > 0.98 > found.naive
    assert not [warning for warning in run.fit.warnings if "hardly better" in warning or "worse than" in warning]


@pytest.mark.usefixtures("quick_fits")
def test_whole_solutions_are_fitted_to_exact_data_of_which_a_state_is_not_measured(tmp_path: Path) -> None:
    hidden = train(model_of(DRIVE), drive_data(60), TrainOptions(workers=1, seed=1), tmp_path / "hidden")
    losses = [float(row["loss"]) for row in hidden.history() if row["stage"] == StageName.WHOLE]
    assert losses[-1] < 0.9 * losses[0]
    measured = model_of(DRIVE + "observe v\n")
    run = train(measured, with_speeds(drive_data(60)), TrainOptions(workers=1, seed=1), tmp_path / "measured")
    assert StageName.WHOLE not in [row["stage"] for row in run.history()]


@pytest.mark.parametrize(("loss", "rests"), [(1e-11, False), (1e-16, True)])
def test_whole_solutions_of_exact_data_are_fitted_until_they_rest(
    loss: float, rests: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loss of 1e-11 is not the end: two tanks with an error of 3 % in an outflow had 7e-11."""
    context = context_of(model_of(DRIVE), drive_data(20))
    parameters = context.parameters(
        {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    )
    theta = parameters.vector(context.module.weights)
    monkeypatch.setattr(whole, "mean_loss", lambda residuals: loss)
    options = LevenbergOptions()
    planned = whole.whole_of_exact_data(context, lambda _: parameters, "normal", lambda _: options, lambda _: True)
    assert planned.wanted(Reached(theta, {})) is not rests


@pytest.mark.parametrize("tolerance", [None, 1e-5])
def test_whole_solutions_by_adaptive_steps_are_fitted_where_all_states_are_measured(
    tolerance: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fast rates that nearly cancel: Robertson's had an error of 0.8 % at a loss of 8e-10, 0.01 % at 4e-12."""
    context = context_of(model_of(DRIVE + "observe v\n"), with_speeds(drive_data(20)))
    context.options = replace(context.options, tolerance=tolerance)
    parameters = context.parameters(
        {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    )
    monkeypatch.setattr(whole, "mean_loss", lambda residuals: 1e-10)
    options = LevenbergOptions()
    planned = whole.whole_of_exact_data(context, lambda _: parameters, "normal", lambda _: options, lambda _: True)
    theta = parameters.vector(context.module.weights)
    assert planned.wanted(Reached(theta, {})) is (tolerance is not None)


@pytest.mark.parametrize("stage", [StageName.WHOLE, StageName.FINER])
def test_measured_initial_states_that_an_earlier_stage_moved_stay_where_they_are(stage: StageName) -> None:
    """Also where the stage that moved them was not followed by one of whole solutions with free initial states."""
    context = context_of(model_of(DRIVE), drive_data(20))
    fixed = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    parameters, released = (context.parameters(fixed, released=free) for free in (False, True))
    theta = parameters.vector(context.module.weights)
    stages = [planned for planned in plan(context, parameters) if planned.name is stage]
    for moved, layout in ((theta, parameters), (released.with_starts(theta, np.array([[0.1, 0.0]])), released)):
        built = stages[0].make(Reached(moved, {StageName.TEACHER: theta}))
        assert isinstance(built, LevenbergMarquardt)
        used = built.engine_at(0).parameters
        np.testing.assert_array_equal(used.start_free, layout.start_free)
        assert float(used.starts(torch.from_numpy(moved))[0, 0]) == pytest.approx(0.1 if layout is released else 0.0)


@pytest.mark.usefixtures("quick_fits")
@pytest.mark.parametrize("segments_too", [False, True])
def test_segments_are_tried_where_no_interval_can_be_fitted(
    segments_too: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The failure of an earlier stage is told; the fit fails only where segments fail too."""
    step, begin = LevenbergMarquardt.step, GrowingHorizons.begin

    def failing(self: LevenbergMarquardt, state: State, iteration: int) -> Outcome:
        if self.name in (StageName.TEACHER, StageName.IMPUTED):
            raise ComputationError("the solution blew up")
        return step(self, state, iteration)

    def begun(self: GrowingHorizons, theta: np.ndarray) -> State:
        if segments_too:
            raise ComputationError("segments blew up")
        return begin(self, theta)

    monkeypatch.setattr(LevenbergMarquardt, "step", failing)
    monkeypatch.setattr(GrowingHorizons, "begin", begun)
    options = TrainOptions(workers=1, seed=1, effort="low")
    if segments_too:
        with pytest.raises(ComputationError, match="segments blew up"):
            train(model_of(DRIVE), drive_data(), options, tmp_path / "run")
        return
    run = train(model_of(DRIVE), drive_data(), options, tmp_path / "run")
    (member,) = run.fit.members
    assert StageName.HORIZONS in [stage.name for stage in member.stages]
    assert [w for w in run.fit.warnings if "failed: the solution blew up; segments" in w]


RELAXATION = """
model relaxation
time t from 0
state x in [-5, 5]
learn k = 0.3 in [0.01, 10]
unknown f(x in [-5, 5]) by mlp(4)
x' = 0.1*f - k*x
observe x
"""


def test_segments_are_not_tried_where_other_initial_states_bring_solutions_back() -> None:
    """A start that teacher forcing left far off says nothing against the dynamics; a wrong constant does."""
    model, times = model_of(RELAXATION), np.linspace(0.5, 10, 20)

    def of(values: Array) -> Trajectories:
        tables = [column[:, None] for column in values.T]
        parts = [(np.ones_like(table), np.full_like(table, np.nan)) for table in tables]
        items = zip(tables, parts, strict=True)
        return Trajectories(tuple(Trajectory("1", 0.0, times, v, n, s, np.zeros(0)) for v, (n, s) in items), ("x",))

    guess = np.exp(-0.3 * times)[:, None] * np.array([1.0, -2.0, 3.0])
    for _ in range(2):  # values of the first guess, then those of the model itself
        context = context_of(model, of(guess))
        fixed = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
        whole, kept = context.parameters(fixed, released=True), context.parameters(fixed)
        starts = np.array([[1.0], [-2.0], [3.0]])
        theta = whole.with_starts(whole.vector(context.module.weights), starts)
        guess = predicted(context.engine(whole, 0.0), theta).mean.reshape(3, 20).T
    (planned,) = [one for one in plan(context, kept) if one.name is StageName.HORIZONS]

    def tried(at: Array) -> bool:
        return planned.due(Reached(at, {StageName.TEACHER: at}))

    far = np.array([[0.0], [0.0], [-4.0]])
    assert not tried(theta)
    assert not tried(whole.with_starts(theta, starts + far))
    faster = theta.copy()
    faster[whole.n_weights] += 3
    assert tried(faster)
