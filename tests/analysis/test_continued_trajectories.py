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


def test_intervals_that_measurements_refute_are_told() -> None:
    refuted, held, few = Errors(40, 1.0, 1.0, 0.3), Errors(40, 1.0, 1.0, 0.8), Errors(9, 1.0, 1.0, 0.1)
    (said,) = said_of_coverage({"x": refuted, "y": held, "z": few})
    assert said.startswith("30 % of the values of `x`")
