"""Trajectories that begin with the rows of one of the training data, and go on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis.prediction.forecast import Errors, forecast, said_of_coverage
from gbspec.analysis.validation.validate import validate
from gbspec.data import DoseEvents, Signal, Trajectories, Trajectory, beginnings, continued
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

TIMES = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])


def decay(label: str, rate: float, rows: int = len(TIMES), seed: int = 0) -> Trajectory:
    noise = 1 + 0.02 * np.random.default_rng(seed).standard_normal(len(TIMES))
    values = 10 * np.exp(-rate * TIMES) * noise
    return trajectory(label, 0.0, TIMES[:rows], values[:rows, None], [])


def begins(known: object, item: Trajectory) -> tuple[int, int] | None:
    """What one trajectory begins with."""
    (found,) = continued(known, [item])
    return found


def test_the_longest_beginning_is_found_whatever_follows() -> None:
    known = beginnings([decay("a", 0.3, 3), decay("b", 0.3, 5), decay("c", 0.5, 4), decay("d", 0.7, 1)])
    assert begins(known, decay("x", 0.3)) == (1, 5)
    assert begins(known, decay("x", 0.5)) == (2, 4)
    assert begins(known, decay("x", 0.7)) is None, "one row is no beginning"
    assert begins(known, decay("x", 0.3, seed=1)) is None
    assert begins(known, decay("x", 0.3, 4)) == (0, 3)
    assert begins(None, decay("x", 0.3)) is None, "an older run does not know"


def test_inputs_and_doses_that_go_on_and_rows_without_a_value_change_no_beginning() -> None:
    short = decay("a", 0.3, 4)
    signal, dose = Signal(TIMES[:4], np.ones(4)), DoseEvents(np.array([1.0]), np.array([2.0]))
    known = beginnings([replace(short, inputs=(signal,), doses=(dose,))])
    longer = decay("a", 0.3)
    values, counts = longer.values.copy(), longer.counts.copy()
    values[4:], counts[4:] = np.nan, 0
    ahead = replace(
        longer, values=values, counts=counts, inputs=(Signal(TIMES, np.ones(10)),),
        doses=(DoseEvents(np.array([1.0, 6.0]), np.array([2.0, 2.0])),),
    )  # fmt: skip
    assert begins(known, ahead) == (0, 4)
    for other in (
        replace(ahead, inputs=(Signal(TIMES, np.full(10, 2.0)),)),
        replace(ahead, doses=(DoseEvents(np.array([1.0]), np.array([20.0])),)),
    ):
        assert begins(known, other) is None, "what acted until then is another"


TWO = """model two
time t from 0
state x in [0, 20]
state y in [0, 20] = 1
learn k = 0.5 in [0.05, 5]
x' = -k*x
y' = k*x - 0.1*y
initial x = 10
observe x
observe y
"""


@pytest.mark.parametrize("stages", ["least squares", ""])
def test_first_values_that_the_training_believed_are_known_with_their_noise(tmp_path: Path, stages: str) -> None:
    """The model gives the start of x, whatever its first row measures; that of y is measured."""
    random = np.random.default_rng(4)
    exact = np.stack([10 * np.exp(-0.5 * TIMES), 1 + 0 * TIMES], axis=1)
    for i in range(1, len(TIMES)):
        exact[i, 1] = exact[0, 1] * np.exp(-0.1 * TIMES[i]) + 12.5 * (np.exp(-0.1 * TIMES[i]) - np.exp(-0.5 * TIMES[i]))
    values = exact + 0.1 * random.standard_normal(exact.shape)
    first, whole = (trajectory("1", 0.0, TIMES[:n], values[:n], []) for n in (6, 10))
    options = TrainOptions(effort="low", stages=stages) if stages else TrainOptions(effort="low")
    run = train(model_of(TWO), Trajectories((first,), ("x", "y")), options, tmp_path / "run")
    (item,) = forecast(run, Trajectories((whole,), ("x", "y"))).items
    learned = run.member().weights["initial"][0]
    believed = learned[1] == values[0, 1]
    assert learned[0] == 10 and item.start.origin == "continued"
    noise = run.fit.noise["y"]
    certain = float(np.sqrt(item.sd[-1, 1] ** 2 - noise**2))
    if believed:  # the first value of y decays by a half until the last row
        assert certain > 0.4 * noise
    assert certain < 2 * noise


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    model = model_of(
        "model decay\ntime t from 0\nstate x in [0, 20]\nlearn k = 0.3 in [0.05, 5] per trajectory\n"
        "learn b = 0.1 in [0, 1]\nx' = -k*x - b*0.01*x\nobserve x\n"
    )
    data = Trajectories((decay("a", 0.3, 5), decay("b", 0.6, 5, 1), decay("c", 0.9, 5, 2)), ("x",))
    return train(model, data, TrainOptions(effort="low"), tmp_path_factory.mktemp("decays") / "run")


def test_what_was_learned_of_a_trajectory_predicts_its_later_rows(run: Run) -> None:
    found = forecast(run, Trajectories((decay("new name", 0.6, seed=1), decay("other", 0.4, seed=9)), ("x",)))
    again, other = found.items
    assert again.start.origin == "continued"
    assert again.used == ("training",) * 5 + ("predicted",) * 5
    rate = again.start.constants[run.model.constant_names.index("k")]
    assert rate == pytest.approx(float(run.member().weights["per_trajectory.k"][1]))
    np.testing.assert_allclose(again.mean[5:, 0], 10 * np.exp(-0.6 * TIMES[5:]), rtol=0.1)
    assert (again.sd[5:, 0] > 0).all()
    assert other.start.origin == "estimated"
    assert found.errors()["x"].n == 5 + other.used.count("predicted")
    assert "the first rows are of the training data" in str(found)


def test_a_validation_takes_what_was_learned_of_the_first_rows(run: Run) -> None:
    table = Trajectories((decay("new name", 0.6, seed=1), decay("other", 0.4, seed=9)), ("x",))
    found, ahead = validate(run, table, truth=False), forecast(run, table)
    again, other = found.trajectories
    assert (again.initial, other.initial) == ("continued", "estimated")
    np.testing.assert_allclose(found.predictions[0].channels[:, 0], ahead.items[0].mean[:, 0], rtol=1e-9)
    line = "1 trajectory: the first rows are of the training data"
    assert line in str(found) and line in str(ahead)
    assert sum("`new name`" in warning for warning in found.warnings) == 0, "its start was not estimated"
    assert "first rows" not in str(validate(run, Trajectories(table.items[1:], ("x",)), truth=False))


def test_a_window_that_is_given_is_kept_and_training_rows_are_no_errors(run: Run) -> None:
    (item,) = forecast(run, Trajectories((decay("b", 0.6, seed=1),), ("x",)), window=3).items
    assert item.start.origin == "estimated"
    assert item.used == ("window",) * 3 + ("training",) * 2 + ("predicted",) * 5


def test_a_trajectory_without_measurements_starts_from_the_average(run: Run) -> None:
    new = decay("new", 0.4, seed=9)
    ahead = forecast(run, Trajectories((ahead_of(new, 0),), ("x",)))
    (item,) = ahead.items
    mean = float(np.mean(np.asarray(run.member(0).weights["initial"])))
    assert item.start.origin == "average" and item.estimated and item.mean[0, 0] == pytest.approx(mean, rel=0.1)
    assert "nothing was measured in the first rows: what is unknown is the mean of the training" in str(ahead)
    (seen,) = forecast(run, Trajectories((new,), ("x",))).items
    assert seen.start.origin == "estimated" and item.sd[0, 0] > seen.sd[0, 0]


def ahead_of(item: Trajectory, measured: int) -> Trajectory:
    """The same trajectory, of which the rows after the first `measured` ones have no values."""
    values, counts = item.values.copy(), item.counts.copy()
    values[measured:], counts[measured:] = np.nan, 0
    return replace(item, values=values, counts=counts)


@pytest.mark.parametrize("window", [None, 3])
def test_rows_after_the_training_are_predicted_the_same_with_and_without_values(run: Run, window: int | None) -> None:
    filled = decay("b", 0.6, seed=1)
    tables = [Trajectories((item,), ("x",)) for item in (filled, ahead_of(filled, 5))]
    (known,), (blank,) = (forecast(run, table, window=window).items for table in tables)
    assert blank.used == known.used and blank.start.origin == known.start.origin
    np.testing.assert_allclose(blank.mean, known.mean, rtol=1e-9)
    np.testing.assert_allclose(blank.sd, known.sd, rtol=1e-9)


def test_rows_of_the_training_are_as_uncertain_as_where_they_go_on(run: Run) -> None:
    """A gap between measurements is no more certain for lying between rows of the training."""
    shown = decay("b", 0.6, 5, seed=1)
    times = np.insert(shown.times, 4, 1.7)  # a row without a value
    values = np.insert(shown.values, 4, np.nan, axis=0)
    counts, sd = np.insert(shown.counts, 4, 0, axis=0), np.insert(shown.sd, 4, np.nan, axis=0)
    gap = replace(shown, times=times, values=values, counts=counts, sd=sd)
    longer = ahead_of(decay("b", 0.6, seed=1), 5)
    found = [forecast(run, Trajectories((item,), ("x",))).items[0] for item in (shown, longer, gap)]
    assert [one.start.origin for one in found] == ["learned", "continued", "learned"]
    np.testing.assert_allclose(found[0].sd, found[1].sd[:5], rtol=1e-6)
    np.testing.assert_allclose(found[0].sd, np.delete(found[2].sd, 4, axis=0), rtol=1e-6)
    noise = run.fit.noise["x"]
    assert (found[2].sd[1:] > noise).all(), "what is not known of the solution is there in every row"


def test_intervals_that_measurements_refute_are_told() -> None:
    refuted, held, few = Errors(40, 1.0, 1.0, 0.3), Errors(40, 1.0, 1.0, 0.8), Errors(9, 1.0, 1.0, 0.1)
    (said,) = said_of_coverage({"x": refuted, "y": held, "z": few})
    assert said.startswith("30 % of the values of `x`")
