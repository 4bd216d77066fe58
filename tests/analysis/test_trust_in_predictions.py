"""Predictions say what the fit left of trust in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.analysis.prediction.forecast import forecast
from gbspec.data import Trajectories
from gbspec.runs import ChannelRecord, LikelihoodRecord, MemberRecord, WhitenessRecord, said_of_training
from gbspec.training import TrainOptions, train
from gbspec.training.runs.verdict import innovations
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

FOLLOWED = ChannelRecord(0.98, 0.1, autocorrelation=0.0, pairs=100)
LOST = ChannelRecord(0.3, 0.1, autocorrelation=0.9, pairs=100)
BLOWN_UP = ChannelRecord(None, 0.1)
COLOURED = ChannelRecord(0.98, 0.1, autocorrelation=0.6, pairs=100)


def member(**channels: ChannelRecord) -> MemberRecord:
    return MemberRecord(1, 0.1, {}, 1.0, (), 0, None, None, channels)


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ([member(x=FOLLOWED, y=FOLLOWED)], []),
        ([member(x=FOLLOWED, y=LOST)], ["`y` (R² 0.3) badly"]),
        ([member(x=BLOWN_UP)], ["`x` badly"]),
        ([member(x=LOST), member(x=FOLLOWED)], []),
        ([member(x=BLOWN_UP), member(x=LOST)], ["`x` (R² 0.3) badly"]),
        ([member(x=COLOURED, y=LOST)], ["`y` (R² 0.3) badly", "residuals of `x` in the training data"]),
        ([member()], []),
    ],
)
def test_what_all_members_leave_is_told(members: list[MemberRecord], said: list[str]) -> None:
    found = said_of_training(members)
    assert len(found) == len(said)
    assert all(words in text for words, text in zip(said, found, strict=True))


@pytest.mark.parametrize(
    ("p", "autocorrelation", "said"),
    [(1e-40, 0.05, True), (0.2, 0.05, False), (0.2, 0.6, True), (None, 0.6, True)],
    ids=["by many rows", "independent", "by the next row", "not tested"],
)
def test_innovations_that_the_fit_calls_dependent_are_told(p: float | None, autocorrelation: float, said: bool) -> None:
    """As the fit does: also where only correlations with later rows than the next one show it."""
    record = ChannelRecord(0.98, 0.1, autocorrelation=autocorrelation, pairs=500)
    tests = {} if p is None else {"x": WhitenessRecord(500, 20, 300.0, p, 0.1, p)}
    likelihood = LikelihoodRecord("innovations", -100.0, 3, 500, -94.0, -80.0, whiteness=tests)
    found = said_of_training([replace(member(x=record), likelihood=likelihood)])
    assert [text.startswith("the innovations of `x` in the training data are not independent: ") for text in found] == (
        [True] if said else []
    )
    assert bool(innovations({"x": record}, likelihood)) is said


def test_a_forecast_of_further_rows_tells_of_autocorrelated_residuals(tmp_path: Path) -> None:
    model = model_of(
        "model fall\ntime t from 0\nstate x in [0, 2] = 1\nlearn k = 0.5 in [0.1, 3]\nx' = -k*x\ninitial x = 1\n"
        "observe x\n"
    )
    times = np.linspace(0.1, 6, 60)
    values = (np.exp(-0.5 * times) + 0.05 * np.sin(2 * times))[:, None]
    first, item = (trajectory("1", 0.0, times[:rows], values[:rows], []) for rows in (40, 60))
    run = train(model, Trajectories((first,), ("x",)), TrainOptions(effort="low", max_step=0.1), tmp_path / "run")
    words = "residuals of `x` in the training data are autocorrelated"
    assert any(words in warning for warning in forecast(run, Trajectories((item,), ("x",)), window=40).warnings)
    assert not forecast(run, Trajectories((first,), ("x",))).warnings, "of the training rows the fit has told it"


def test_rows_that_an_event_may_pass_have_both_sides_in_their_bands(tmp_path: Path) -> None:
    """Such rows lie in the interval of the learned time; others have the band of their own side."""
    model = model_of(
        "model step\ntime t from 0\nstate x in [0, 20] = 2\nlearn T = 4 in [1, 12]\nx' = -0.15*x\ninitial x = 2\n"
        "event second at T: x = x + 6\nobserve x noise normal(0.35)\n"
    )

    def solution(times: np.ndarray) -> np.ndarray:
        return 2 * np.exp(-0.15 * times) + np.where(times < 5.3, 0.0, 6 * np.exp(-0.15 * (times - 5.3)))

    times = np.arange(0, 21, 3.0)
    noise = 0.35 * np.random.default_rng(1).standard_normal(len(times))
    seen = trajectory("1", 0.0, times, (solution(times) + noise)[:, None], [])
    run = train(model, Trajectories((seen,), ("x",)), TrainOptions(effort="low"), tmp_path / "run")
    low, high = run.fit.constants["T"].interval or (np.nan, np.nan)
    between = np.linspace(3, 8, 101)
    (item,) = forecast(
        run, Trajectories((trajectory("2", 0.0, between, solution(between)[:, None], []),), ("x",))
    ).items
    jump, estimate = 6.0, run.fit.constants["T"].value
    passed = (between > low) & (between < high)
    both = (item.high - item.low)[:, 0] > 0.9 * jump
    assert 5 < np.sum(passed) < 60
    assert np.array_equal(both, passed)
    before = passed & (between < estimate)
    assert np.all(item.low[before, 0] > -0.5), "no further down than a band without the event"


def test_conditions_that_have_their_defaults_where_the_training_had_others_are_told(tmp_path: Path) -> None:
    """A table without the column of a condition was judged as showing something that the model lacks."""
    (tmp_path / "m.gb").write_text(
        "model fall\ntime t\ncondition T in [280, 320] = 300\nstate x in [0, 2] = 1\nlearn k = 0.5 in [0.1, 3]\n"
        "x' = -k*x*exp((T - 300)/20)\ninitial x = 1\nobserve x\n"
    )
    rows = [(T, t, np.exp(-0.7 * t * np.exp((T - 300) / 20))) for T in (290, 310) for t in np.linspace(0, 3, 9)]
    (tmp_path / "d.csv").write_text("trajectory,t,T,x\n" + "".join(f"{T},{t},{T},{x:.6f}\n" for T, t, x in rows))
    (tmp_path / "n.csv").write_text("trajectory,t,x\n" + "".join(f"{T},{t},{x:.6f}\n" for T, t, x in rows))
    at = [(t, np.exp(-0.7 * t)) for t in np.linspace(0, 3, 9)]
    (tmp_path / "e.csv").write_text("t,T,x\n" + "".join(f"{t},300,{x:.6f}\n" for t, x in at))
    run = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run")
    words = "`T` has its default, 300, in all trajectories, as the table has no value of it; the training data had"
    for table, said in (("n.csv", True), ("d.csv", False), ("e.csv", False)):  # e.csv says that it is 300
        for found in (run.predict(tmp_path / table), run.validate(tmp_path / table)):
            assert any(f"{words} 290 to 310" in one for one in found.warnings) is said
