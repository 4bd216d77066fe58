"""What is said of a fit: whole solutions against naive predictors, and stages that end early."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis import forecast
from gbspec.data import LINE
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import ComputationError
from gbspec.ir import ErrorScale
from gbspec.runs import (
    ChannelRecord,
    DataRecord,
    FitRecord,
    SearchRecord,
    StageRecord,
    how_followed,
)
from gbspec.training import TrainOptions, train
from gbspec.training.optimise import LevenbergMarquardt, Outcome, State
from gbspec.training.runs.fit import completed
from gbspec.training.runs.summary import MemberResult, _r2
from gbspec.training.runs.verdict import (
    above_stated,
    autocorrelations,
    blown_up,
    not_followed,
    unrested,
    verdicts,
)
from gbspec.training.runs.warned import warnings_of
from tests.training.conftest import URP, model_of, problem_of, trajectory, urp_data

pytestmark = pytest.mark.usefixtures("quick_fits")


@pytest.mark.parametrize(
    ("r2", "naive", "said"),
    [
        (0.99, 0.5, ""),
        (0.5, 0.0, ""),
        (0.479, 0.104, "badly (R² 0.479: they leave 52.1 % of the variance)"),
        (0.05, 0.0, "hardly better than"),
        (0.0, 0.3, "worse than"),
        (-7.0, -0.2, "worse than"),
        (None, 0.3, ""),
        (0.9, None, ""),
        (0.4, None, "badly"),
    ],
)
def test_a_fit_is_compared_with_the_best_naive_predictor(r2: float | None, naive: float | None, said: str) -> None:
    found = verdicts({"x": ChannelRecord(r2, naive, "the mean of each trajectory")})
    assert len(found) == bool(said)
    assert all(said in text and "`x`" in text and "postulate" in text for text in found)


@pytest.mark.parametrize(
    ("correlation", "pairs", "said"),
    [(0.05, 100, False), (0.5, 100, True), (0.5, 9, True), (None, 0, True), (0.1, 12, False)],
)
def test_noise_that_is_most_of_the_variance_is_no_fault_of_a_fit(
    correlation: float | None, pairs: int, said: bool
) -> None:
    known = ChannelRecord(0.3, 0.0, "the mean", autocorrelation=correlation, pairs=pairs)
    assert bool(verdicts({"x": known})) == said
    assert how_followed(0.3, [known]) == ("badly" if said else "in part")
    assert how_followed(-0.1, [known]) == "badly"


DECAY = "model m\ntime t\nstate x = 1\nlearn k = 1\nlearn r = 1\n{}\nobserve {}\n"


@pytest.mark.parametrize(
    ("balance", "observed", "line"),
    [
        ("x' = -k*x", "x noise lognormal(0.3)", True),
        ("x' = k*x - r*x", "x noise lognormal(0.3)", True),
        ("let g = k - r\nx' = g*x", "y = r*x noise lognormal(0.3)", True),
        ("x' = -k*x", "y = log(x)", True),
        ("x' = k", "x", True),
        ("x' = -k*x", "x", False),
        ("x' = -k*x", "y = x + 1 noise lognormal(0.3)", False),
        ("x' = k*x*(1 - x/r)", "x noise lognormal(0.3)", False),
        ("x' = k*t*x", "x noise lognormal(0.3)", False),
        ("unknown q(x) by mlp(2)\nx' = q*x", "x noise lognormal(0.3)", False),
        ("input u held\nx' = u*x", "x noise lognormal(0.3)", False),
        ("x' = -k*x", "x noise lognormal(0.3)\ndose x", False),
        ("x' = if(t > 2, k, r)*x", "x noise lognormal(0.3)", False),
        ("x' = 0*k", "x noise poisson", True),
        ("x' = -k*x", "x noise poisson", True),
        ("x' = k", "x noise poisson", False),
    ],
)
def test_a_model_that_is_a_straight_line_need_not_be_better_than_one(balance: str, observed: str, line: bool) -> None:
    model, (name, *_) = model_of(DECAY.format(balance, observed)), observed.split()
    one = ChannelRecord(0.922, 0.914, LINE, values=44, autocorrelation=0.5, pairs=42)
    assert bool(verdicts({name: one}, model)) != line
    assert bool(verdicts({name: replace(one, r2=0.91)}, model)) != line, "by a weight, or a shared constant"
    (said,) = verdicts({name: replace(one, r2=0.8)}, model)
    assert "worse than a straight line" in said
    assert verdicts({name: replace(one, r2=0.1, naive=0.1, predictor="the mean")}, model)


def test_a_fit_that_obeys_limits_may_be_worse_than_what_does_not_know_them() -> None:
    """Of 60 values 16 are limits."""
    one = ChannelRecord(0.91, 0.914, LINE, values=60, autocorrelation=0.5, pairs=42)
    assert verdicts({"x": one}) and not_followed(one)
    limited = replace(one, censored=16)
    assert not verdicts({"x": limited}) and not not_followed(limited)
    assert verdicts({"x": replace(limited, r2=0.85)}) and verdicts({"x": replace(limited, censored=1)})
    (said,) = verdicts({"x": replace(limited, r2=0.89)})
    assert "worse than a straight line" in said, "it is, and not by less than the limits allow"


@pytest.mark.parametrize(
    ("r2", "naive", "said"),
    [
        (-0.24, 0.92, "do not rely on this fit"),
        (-1.5, 0.0, "do not rely on this fit"),
        (-0.8, 0.0, "do not rely on predictions of `x`"),
        (-0.02, 0.0, ""),
        (0.91, 0.92, ""),
        (0.88, 0.92, ""),
        (0.86, 0.92, "do not rely on predictions of `x`"),
        (0.6, 0.92, "do not rely on this fit"),
        (1 - 2e-7, 1 - 1e-7, ""),
        (0.5, None, ""),
    ],
)
def test_predictions_one_row_ahead_are_compared_with_the_last_value(r2: float, naive: float | None, said: str) -> None:
    model = model_of("model m\nstate x = 1\nlearn s = 1\nx' = 0\ndiffusion x = s\nobserve x\n")
    found = verdicts({"x": ChannelRecord(r2, naive, "the last value before", values=42)}, model)
    assert bool(found) == bool(said)
    assert all("`diffusion x = s*x`" in text and said in text for text in found)


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ("", "", ("smaller starts of the sizes", "`diffusion x = s*x`", "of the other constants")),
        ("learn s = 1", "const s = 1", ("`diffusion x = s*x`", "of the constants")),
        ("diffusion x = s", "diffusion x = s*x", ("smaller starts of the sizes", "of the other constants")),
        ("learn r = 1 in [0, 2]", "const r = 1", ("smaller starts of the sizes", "`diffusion x = s*x`")),
    ],
)
def test_what_a_model_with_disturbances_has_is_no_remedy(before: str, after: str, named: tuple[str, ...]) -> None:
    text = "model m\nstate x = 1\nlearn s = 1\nlearn r = 1 in [0, 2]\nx' = r*x\ndiffusion x = s\nobserve x\n"
    model = model_of(
        (text if "0.1" not in after else text.replace("learn r = 1 in [0, 2]\n", "")).replace(before, after)
    )
    record = {"x": ChannelRecord(-0.24, 0.92, "the last value before", values=42)}
    (said,) = verdicts(record, model)
    every = ("smaller starts of the sizes", "`diffusion x = s*x`", "of the other constants", "of the constants")
    assert tuple(one for one in every if one in said) == named
    assert said.endswith("or another model") and "bounds" not in said
    (wider,) = verdicts(record, model, ["r"])
    assert "What may help: wider bounds of `r`, if values beyond them are plausible, " in wider


HIDDEN_STATE = "model m\nstate x\nstate w{range}\n{k}unknown f(w)\nx' = f\nw' = {rate} - w\nobserve x noise normal(1)\n"


@pytest.mark.parametrize(
    ("bounds", "learned", "ranges", "narrower"),
    [("", True, True, True), (" in [0, 9]", True, False, True), ("", False, True, False)],
)
def test_ranges_that_are_declared_are_no_remedy(bounds: str, learned: bool, ranges: bool, narrower: bool) -> None:
    k = ("learn k = 1\n", "k") if learned else ("", "1")
    model = model_of(HIDDEN_STATE.format(range=bounds, k=k[0], rate=k[1]))
    record = {"x": ChannelRecord(-0.1, 0.2, "the mean of each trajectory", autocorrelation=0.9, pairs=100, values=101)}
    (followed,) = verdicts(record, model)
    (rest,) = unrested(record, "", model)
    (stated,) = above_stated({"x": 9.0}, model)
    for text in (followed, rest, stated):
        assert ("ranges of unmeasured states" in text) is ranges
    for text in (rest, stated):
        assert ("narrower bounds" in text) is narrower


def test_a_model_without_unknown_functions_is_not_told_to_change_them() -> None:
    model = model_of("model m\nstate x = 1\nlearn k = 1\nx' = -k*x\nobserve x\n")
    (said,) = verdicts({"x": ChannelRecord(-0.1, 0.2, "the mean of each trajectory")}, model)
    assert "unknown function" not in said and "network" not in said
    assert "what may help" in said


def test_every_method_says_so(tmp_path: Path) -> None:
    options = TrainOptions(method="adam", epochs=1, warm_start=False, learning_rate=1e-6, max_step=0.1, workers=1)
    run = train(model_of(URP), urp_data(3, 4.0, 6), options, tmp_path / "run")
    assert any("`x2` worse than" in warning or "`x2` hardly better" in warning for warning in run.fit.warnings)


def test_a_stage_that_blows_up_keeps_what_was_reached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = LevenbergMarquardt.step

    def blown(self: LevenbergMarquardt, state: State, iteration: int) -> Outcome:
        if self.name == "blend":
            raise ComputationError("the solution blows up in trajectory `1` at time 2")
        return step(self, state, iteration)

    monkeypatch.setattr(LevenbergMarquardt, "step", blown)
    options = TrainOptions(stages="teacher forcing; blend; autoregressive", effort="low", max_step=0.1, workers=1)
    run = train(model_of(URP), urp_data(3, 2.0, 6), options, tmp_path / "run")
    names = [stage.name for stage in run.fit.members[0].stages]
    assert names == ["warm start", "teacher forcing", "autoregressive"]
    assert any("the stage `blend` ended early" in warning and "at time 2" in warning for warning in run.fit.warnings)


def test_a_first_stage_that_blows_up_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def blown(self: LevenbergMarquardt, state: State, iteration: int) -> Outcome:
        raise ComputationError("the solution blows up")

    monkeypatch.setattr(LevenbergMarquardt, "step", blown)
    with pytest.raises(ComputationError):
        train(model_of(URP), urp_data(3, 2.0, 6), TrainOptions(stages="blend", workers=1), tmp_path / "run")


def test_a_good_fit_of_data_that_a_line_follows_too_is_not_doubted() -> None:
    """Logarithms of a bolus in one compartment are a straight line."""
    white = ChannelRecord(0.998, 0.998, "a straight line", autocorrelation=0.1, pairs=80)
    assert not verdicts({"x": white})
    assert verdicts({"x": replace(white, autocorrelation=0.9)})
    assert verdicts({"x": replace(white, r2=0.2, naive=0.2)})


def test_intervals_are_not_called_wide_where_there_are_none() -> None:
    followed = {"x": ChannelRecord(0.9, 0.0, autocorrelation=0.9, pairs=100)}
    assert "times as wide" in autocorrelations(followed)[0]
    assert "times as wide" not in autocorrelations(followed, intervals=False)[0]
    model = model_of("model m\nstate x = 1\nlearn k = 1\nx' = -k*x\nobserve x\n")
    result = replace(fitted(0.0, 0.9), channels=followed)
    assert not any("times as wide" in one for one in warnings_of({0: result}, TrainOptions(), model))


def fitted(sd: float, r2: float, *stages: StageRecord) -> MemberResult:
    channels = {"x": ChannelRecord(r2, 0.0, autocorrelation=0.9, pairs=100)}
    known = {"k": sd}
    return MemberResult(0, 0.1, 0.1, channels, {"x": 1.0}, {}, {"k": 1.0}, known, 1.0, list(stages), np.zeros(0), [])


@pytest.mark.parametrize(
    ("sd", "r2", "iterations", "said"),
    [
        (0.1, 0.997, 100, "intervals are"),
        (np.nan, 0.997, 100, "not come to rest (`autoregressive` ended after its 100 iterations)"),
        (np.nan, 0.997, 7, "not come to rest: "),
        (np.nan, 1 - 1e-5, 100, ""),
    ],
)
def test_a_fit_without_intervals_says_that_its_residuals_are_no_noise(
    sd: float, r2: float, iterations: int, said: str
) -> None:
    """Constants have no standard deviations where a stage ended before it rested, which was passed over in silence."""
    stages = (StageRecord("initial states", 1, 0.2, 1.0), StageRecord("autoregressive", iterations, 0.1, 1.0))
    found = warnings_of({0: fitted(sd, r2, *stages)}, TrainOptions(members=1))
    assert len(found) == bool(said)
    assert all(said in text and "autocorrelated" in text for text in found)


EACH = """model each
state x in [0, 2]
learn k = 0.5 in [0.1, 3] per trajectory
x' = -k*x
initial x = 1
observe x
"""


@pytest.mark.parametrize(
    ("own_sd", "said"),
    [
        ((0.1, 0.2), ""),
        ((0.1, np.nan), "`k` has no interval in 1 of 2 trajectories (`b`): the fit has not come to rest there"),
        ((np.nan, np.nan), "constants have no intervals: the fit has not come to rest"),
    ],
)
def test_constants_of_trajectories_have_intervals_of_their_own(own_sd: tuple[float, float], said: str) -> None:
    """Where trajectories share no constant, none can lack the standard deviation of a shared one."""
    known = replace(
        fitted(np.nan, 0.9, StageRecord("least squares", 1, 0.1, 1.0)),
        channels={"x": ChannelRecord(0.9, 0.0)},
        labels=["a", "b"],
        noise={"x": 0.1},
        own=np.ones((2, 1)),
        own_sd=np.array(own_sd)[:, None],
    )
    model, options = model_of(EACH), TrainOptions(members=1)
    record = FitRecord("0", "m", DataRecord("", "", 2, 4, 4), {}, {}, {}, {}, (), ())
    found = [text for text in completed(record, model, {0: known}, options).warnings if "interval" in text]
    assert len(found) == bool(said)
    assert all(said in text for text in found)


def test_a_fit_whose_constants_of_trajectories_have_no_interval_for_reasons_that_are_told_has_come_to_rest() -> None:
    known = replace(
        fitted(np.nan, 0.9, StageRecord("least squares", 1, 0.1, 1.0)),
        channels={"x": ChannelRecord(0.9, 0.0)},
        labels=["a", "b"],
        noise={"x": 0.1},
        own=np.ones((2, 1)),
        own_sd=np.full((2, 1), np.nan),
    )
    both, record = (
        frozenset({("k", "a"), ("k", "b")}),
        FitRecord("0", "m", DataRecord("", "", 2, 4, 4), *[{}] * 4, (), ()),
    )
    for told in ({"misjudged_own": both}, {"bounded_own": both}):
        warnings = completed(record, model_of(EACH), {0: replace(known, **told)}, TrainOptions(members=1)).warnings
        assert not any("come to rest" in text for text in warnings), warnings


def test_nothing_shared_is_not_missed_in_predictions(tmp_path: Path) -> None:
    times = np.linspace(0.0, 2.0, 9)
    noise = 0.02 * np.random.default_rng(4).standard_normal((2, 9))
    each = [
        trajectory(f"{k}", 0.0, times, (np.exp(-k * times) + e)[:, None], [])
        for k, e in zip((1, 2), noise, strict=True)
    ]
    run = train(model_of(EACH), Trajectories(tuple(each), ("x",)), TrainOptions(effort="low"), tmp_path / "run")
    assert not [text for text in run.fit.warnings if "interval" in text]
    new = Trajectories((trajectory("new", 0.0, times, np.exp(-1.5 * times)[:, None], []),), ("x",))
    found = forecast(run, new)
    assert found.items[0].start.origin == "estimated"
    assert not [text for text in found.warnings if "too narrow" in text]


@pytest.mark.parametrize(
    ("noise", "found", "said"),
    [
        ("normal(0.2)", 0.25, ""),
        ("normal(0.2)", 0.7, "3.5 times as large as the noise that the model states, normal(0.2)"),
        ("lognormal(0.1)", 0.33, "3.3 times"),
        ("", 0.7, ""),
        ("normal(0.1 + 0.1*x)", 0.7, ""),
        ("normal(0.2)", float("nan"), ""),
    ],
)
def test_residuals_that_are_no_stated_noise_are_told(noise: str, found: float, said: str) -> None:
    stated = f" noise {noise}" if noise else ""
    model = model_of(f"model m\nstate x in [0.1, 9]\nlearn k = 1\nx' = -k*x\nobserve x{stated}\n")
    text = "".join(above_stated({"x": found}, model))
    assert bool(text) == bool(said)
    assert said in text


@pytest.mark.parametrize(
    ("search", "doubted"),
    [
        (None, True),
        (SearchRecord(8, 1), True),
        (SearchRecord(8, 2), True),
        (SearchRecord(8, 3), False),
        (SearchRecord(8, 12), False),
    ],
)
def test_a_minimum_that_was_found_several_times_is_not_called_bad(search: SearchRecord | None, doubted: bool) -> None:
    model = model_of("model m\nstate x in [0.1, 9]\nlearn k = 1\nx' = -k*x\nobserve x noise normal(0.2)\n")
    (text,) = above_stated({"x": 0.7}, model, search=search)
    assert ("the fit is in a bad minimum" in text) is doubted
    assert ("`--effort high`" in text) is doubted
    assert "the model lacks something" in text and "the noise is larger" in text and "another model" in text


def test_predictions_of_zero_in_logarithms_have_a_bad_figure_and_not_none() -> None:
    """Without a figure the verdict on the fit would be left out."""
    model = model_of("model m\nstate x = 1\nlearn k = 1\nx' = -k*x\nobserve x noise lognormal(0.1)\n")
    t = np.linspace(0.0, 2.0, 9)
    data = Trajectories((trajectory("1", 0.0, t, np.exp(-t)[:, None], []),), ("x",))
    problem, _, _ = problem_of(model, data, 0.1)
    mean = problem.packed.values.copy()  # [R, 1]
    assert _r2(problem, mean, 0, ErrorScale(logarithms=True)) == pytest.approx(1)
    mean[np.flatnonzero(problem.valued[:, 0])[:2], 0] = 0.0, -1e-3
    found = _r2(problem, mean, 0, ErrorScale(logarithms=True))
    assert found is not None and found < -100


def test_members_in_different_minima_are_told() -> None:
    def of(loss: float) -> MemberResult:
        return replace(fitted(0.1, 0.997), loss=loss, channels={"x": ChannelRecord(0.997, 0.0, values=122)})

    def said(*losses: float) -> list[str]:
        found = warnings_of(dict(enumerate(map(of, losses))), TrainOptions(members=len(losses)))
        return [text for text in found if "different minima" in text]

    (text,) = said(0.00114, 0.001293, 0.00115)
    assert "worse are 1 (loss 0.001293)" in text
    assert not said(0.00114, 0.00116)
    assert not said(1e-13, 1e-11)
    assert not said(0.00114)


@pytest.mark.parametrize(
    ("labels", "said"),
    [
        (["a"], "in trajectory `a`; this trajectory does not count"),
        (["a", "b"], "in trajectories `a`, `b`; these trajectories do not count"),
        (list("abcdefg"), "`e` and 2 more; these"),
    ],
)
def test_trajectories_that_blow_up_are_counted(labels: list[str], said: str) -> None:
    assert said in blown_up(labels)
