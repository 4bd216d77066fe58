"""Cross-validation: how data are divided, what is judged, and the command from end to end."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import gbspec
from gbspec.cli.app import build
from gbspec.data.trajectories import Limits, Trajectories, Trajectory
from gbspec.diagnostics import UserError
from gbspec.fitted import table_of
from gbspec.ir.residual import residuals
from gbspec.runs import open_run
from gbspec.studies.folds import folds, way
from gbspec.studies.heldout import Point, errors
from gbspec.training import filter_run

from .conftest import DECAY

pytestmark = pytest.mark.usefixtures("quick_fits")


def data(trajectories: int, rows: int) -> Trajectories:
    """Trajectories that start at 0 and have their first row at 1; the values tell trajectory and row."""
    items = []
    for k in range(trajectories):
        values = 100.0 * k + np.arange(rows)[:, None]
        nothing = np.full(values.shape, np.nan)
        times = np.arange(1.0, rows + 1)
        items.append(Trajectory(str(k), 0.0, times, values, np.ones_like(values), nothing, np.zeros(0)))
    return Trajectories(tuple(items), ("N",))


def test_few_trajectories_are_left_out_one_by_one() -> None:
    parts = folds(data(12, 3), "trajectories", None, 0)
    assert [[item.label for item in part.whole.items] for part in parts] == [[str(k)] for k in range(12)]
    assert all(len(part.kept) == 11 and part.whole.items[0] not in part.kept.items for part in parts)


def test_many_trajectories_are_dealt_to_five_folds() -> None:
    parts = folds(data(32, 2), "trajectories", None, 0)
    labels = [[item.label for item in part.whole.items] for part in parts]
    assert sorted(len(part) for part in labels) == [6, 6, 6, 7, 7]
    assert sorted(label for part in labels for label in part) == sorted(str(k) for k in range(32))
    assert labels != [[item.label for item in part.whole.items] for part in folds(data(32, 2), "trajectories", None, 1)]


def test_a_single_trajectory_is_cut_into_stretches_and_keeps_its_start() -> None:
    one = data(1, 21)
    assert way(one, None) == "time" and way(data(2, 9), None) == "trajectories" and way(data(2, 9), "time") == "time"
    parts = folds(one, "time", None, 0)
    held = np.array([part.held[0] for part in parts])
    assert (held.sum(axis=0) == 1).all() and sorted(held.sum(axis=1)) == [4, 4, 4, 4, 5]
    for part in parts:
        rows = np.flatnonzero(part.held[0])
        assert (np.diff(rows) == 1).all()
        kept = part.kept.items[0]
        assert kept.start == 0.0 and set(kept.values[:, 0]) == set(range(21)) - set(rows)


def test_limits_and_scatter_stay_with_their_rows() -> None:
    (item,) = data(1, 10).items
    side = np.zeros((10, 1), dtype=np.int8)
    side[7] = -1
    scatter = np.arange(10.0)[:, None]
    censored = replace(item, limits=Limits(np.where(side != 0, 0.1, np.nan), side), scatter=scatter)
    for part in folds(replace(data(1, 10), items=(censored,)), "time", 5, 0):
        kept, rows = part.kept.items[0], np.flatnonzero(~part.held[0])
        assert np.array_equal(np.flatnonzero(kept.censored.side), np.flatnonzero(rows == 7))
        assert kept.scatter is not None and np.array_equal(kept.scatter[:, 0], rows)


def test_what_is_absent_is_known_where_the_first_rows_are_held_out() -> None:
    (item,) = data(1, 10).items
    values = np.column_stack([item.values[:, 0], np.zeros(10)])
    both = replace(item, start=1.0, values=values, counts=np.ones_like(values), sd=np.full(values.shape, np.nan))
    whole = Trajectories((both,), ("N", "M"))
    first, second, *_ = folds(whole, "time", 5, 0, np.array([[False, True]]))
    kept = first.kept.items[0]
    assert kept.times.tolist() == [1.0, *range(3, 11)] and kept.counts[0].tolist() == [0.0, 1.0]
    assert np.array_equal(kept.values[0], [np.nan, 0.0], equal_nan=True)
    assert len(second.kept.items[0].times) == 8


@pytest.mark.parametrize(
    ("trajectories", "rows", "over", "count"), [(3, 5, "trajectories", 4), (1, 5, "time", 3), (1, 9, "trajectories", 2)]
)
def test_data_that_cannot_be_divided(trajectories: int, rows: int, over: str, count: int) -> None:
    with pytest.raises(UserError) as caught:
        folds(data(trajectories, rows), over, count, 0)  # type: ignore[arg-type]  # one of the two words
    assert caught.value.diagnostics[0].code == "GB821"


def test_a_refusal_in_a_fold_says_what_the_fold_leaves_out(tmp_path: Path) -> None:
    path = tmp_path / "m.gb"
    path.write_text(
        "model m\nlearn k = 1 in [0.1, 3] per trajectory ~ lognormal\nstate N\nN' = -k*N\nobserve N noise normal(0.1)\n"
    )
    with pytest.raises(UserError) as caught:
        gbspec.load(path).crossvalidate(table(tmp_path / "t.csv", 3), tmp_path / "out", folds=3, over="time")
    (found,) = caught.value.diagnostics
    assert (found.code, found.notes) == (
        "GB776",
        ("in fold 0, whose fit is without rows at the start of each trajectory",),
    )


def test_errors_by_hand() -> None:
    points = [Point("1", 0, "N", 1.0, 2.0, 1.0), Point("1", 1, "N", 4.0, 2.0, 1.0), Point("1", 2, "N", 1, math.nan, 1)]
    (found,) = errors(points, {"N": 0.5, "M": 1.0}).values()
    assert (found.n, found.unsolved, found.mae, found.covered) == (2, 1, 1.5, 0.5)
    assert found.rmse == pytest.approx(math.sqrt(2.5)) and found.nrmse == pytest.approx(2 * math.sqrt(2.5))
    assert found.rmse_log == pytest.approx(math.log(2))
    assert math.isnan(errors([Point("1", 0, "N", -1.0, 2.0, 1.0)], {"N": 1.0})["N"].rmse_log)


@pytest.mark.parametrize("logarithmic", [False, True])
def test_errors_are_those_of_the_residual(logarithmic: bool) -> None:
    measured = np.array([0.5, 1.0, 3.0, 8.0])
    predicted = np.array([0.7, 1.0, 2.0, 8.0 * 1e-5])  # the last one below the floor of the logarithm
    points = [Point("1", k, "N", y, p, 1.0) for k, (y, p) in enumerate(zip(measured, predicted, strict=True))]
    expected = residuals(predicted[:, None], measured[:, None], np.ones(1), np.array([logarithmic]))
    (found,) = errors(points, {"N": 2.0}).values()
    size = math.sqrt(np.mean(expected**2))
    if logarithmic:
        assert found.rmse_log == pytest.approx(size, rel=1e-14)
        assert size < math.sqrt(np.mean(np.log(predicted / measured) ** 2)), "the tangent bounds it"
    else:
        assert (found.rmse, found.nrmse) == pytest.approx((size, size / 2), rel=1e-14)
        assert found.mae == pytest.approx(np.abs(expected).mean(), rel=1e-14)


def table(path: Path, trajectories: int) -> Path:
    """Solutions of N' = -N from several starts, every quarter to t = 2: what the model of these tests can express."""
    rows = [
        f"{k},{t},{(1 + 0.2 * k) * math.exp(-t)!r}"
        for k in range(trajectories)
        for t in np.arange(0, 2.01, 0.25).tolist()
    ]
    path.write_text("trajectory,t,N\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(("trajectories", "over"), [(3, "trajectories"), (1, "time")])
def test_the_command_predicts_what_it_left_out(tmp_path: Path, trajectories: int, over: str) -> None:
    model, out = tmp_path / "decay.gb", tmp_path / "out"
    model.write_text(DECAY)
    arguments = ["crossvalidate", str(model), str(table(tmp_path / "t.csv", trajectories)), "-o", str(out), "--json"]
    arguments += ["--method", "lm", "--epochs", "8", "--no-warm-start", "--threads", "1", "--folds", "3"]
    result = CliRunner().invoke(build(["crossvalidate"]), arguments)
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["over"] == over and [fold["failure"] for fold in found["folds"]] == [None] * 3
    total = found["total"]["N"]
    # trajectories: the first row of each is its start, which is measured; time: every row is in one stretch
    assert (
        total["n"] == (3 * 8 if over == "trajectories" else 9) == sum(f["channels"]["N"]["n"] for f in found["folds"])
    )
    assert total["unsolved"] == 0 and total["nrmse"] < 0.3
    assert (out / "predictions.csv").read_text().count("\n") == total["n"] + 1
    before = (out / "folds" / "0.json").stat().st_mtime_ns
    (out / "folds" / "1.json").unlink()  # as if it had been stopped there
    again = CliRunner().invoke(build(["crossvalidate"]), arguments)
    assert json.loads(again.stdout) == found and (out / "folds" / "0.json").stat().st_mtime_ns == before
    how = {"method": "lm", "epochs": 8, "warm_start": False, "threads": 1}
    from_python = gbspec.load(model).crossvalidate(tmp_path / "t.csv", out, folds=3, **how)
    assert from_python.to_json() == found
    quiet = CliRunner().invoke(build(["crossvalidate"]), [one for one in arguments if one != "--json"] + ["-q"])
    assert quiet.stdout == (out / "table.md").read_text()
    other = CliRunner().invoke(build(["crossvalidate"]), [*arguments, "--seed", "1"])
    assert other.exit_code == 1 and "GB820" in other.stderr


def test_a_directory_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "decay.gb").write_text(DECAY)
    arguments = ["crossvalidate", str(tmp_path / "decay.gb"), str(table(tmp_path / "t.csv", 2)), "-o", str(tmp_path)]
    result = CliRunner().invoke(build(["crossvalidate"]), arguments)
    assert result.exit_code == 1 and "GB806" in result.stderr


DISTURBED = """model disturbed "Relaxation with a random disturbance"
time t
state x in [-10, 10]
learn s = 0.5 in [0.01, 5]
x' = -x
diffusion x = s
observe x noise normal(0.1)
"""


def test_disturbed_models_are_also_judged_one_row_ahead(tmp_path: Path) -> None:
    rng, x, rows = np.random.default_rng(4), 1.0, []
    decay, spread = math.exp(-0.5), 0.6 * math.sqrt((1 - math.exp(-1.0)) / 2)
    for k in range(40):
        rows.append((0.5 * k, x + 0.1 * rng.normal()))
        x = decay * x + spread * rng.normal()
    model, path = tmp_path / "disturbed.gb", tmp_path / "t.csv"
    model.write_text(DISTURBED)
    path.write_text("t,x\n" + "".join(f"{t},{y!r}\n" for t, y in rows))
    found = gbspec.load(model).crossvalidate(path, tmp_path / "out", folds=4, threads=1)
    point = next(p for p in found.points if p.time == 5.0)
    # A scalar Kalman filter with the fit of the fold that holds this row out, from a start that is long forgotten.
    s = gbspec.open_run(tmp_path / "out" / "folds" / "1").constants["s"]
    mean, variance = rows[0][1], 0.01
    for _, y in rows[1:10]:
        mean, variance = mean * decay, variance * decay**2 + s**2 * (1 - decay**2) / 2
        gain = variance / (variance + 0.01)
        mean, variance = mean + gain * (y - mean), variance * (1 - gain)
    expected = variance * decay**2 + s**2 * (1 - decay**2) / 2 + 0.01
    assert point.ahead == pytest.approx(mean * decay, rel=1e-3)
    assert math.sqrt(expected) * 0.999 <= point.ahead_sd < 1.2 * math.sqrt(expected)
    assert math.isnan(next(p for p in found.points if p.time == 0.0).ahead)
    assert found.ahead["x"].n == 39 and found.ahead["x"].rmse < found.total["x"].rmse
    assert "| all, one row ahead | x | 39 |" in (tmp_path / "out" / "table.md").read_text()


def test_disturbed_trajectories_left_out_are_predicted_from_their_first_rows(tmp_path: Path) -> None:
    """As `predict` does with that window, with the uncertainty of the constants of the fit to the others."""
    rng, rows, count = np.random.default_rng(7), [], 12
    decay, spread = math.exp(-0.5), 0.6 * math.sqrt((1 - math.exp(-1.0)) / 2)
    for k in range(3):
        x = 2.0
        for i in range(count):
            rows.append((k, 0.5 * i, x + 0.1 * rng.normal()))
            x = decay * x + spread * rng.normal()
    model, path = tmp_path / "disturbed.gb", tmp_path / "t.csv"
    model.write_text(DISTURBED.replace("x' = -x", "learn r = 1.2 in [0.1, 5]\nx' = -r*x"))
    path.write_text("trajectory,t,x\n" + "".join(f"{k},{t},{y!r}\n" for k, t, y in rows))
    for window in (None, 5):
        out, first = tmp_path / f"out{window}", window or 4  # a third of the rows
        found = gbspec.load(model).crossvalidate(path, out, window=window, threads=1)
        assert found.total["x"].n == 3 * (count - first)
        assert found.total["x"].rmse > 0.2, "a measured value is not predicted from itself"
        for k in range(3):
            run = gbspec.open_run(out / "folds" / str(k))
            (item,) = (one for one in run.predict(path, window=first).items if one.label == str(k))
            points = [point for point in found.points if point.trajectory == str(k)]
            assert [point.time for point in points] == item.times[first:].tolist()
            assert np.allclose([point.predicted for point in points], item.mean[first:, 0], atol=1e-6)
            assert np.allclose([point.sd for point in points], item.sd[first:, 0], rtol=1e-5)
            # A scalar Kalman filter up to the window, and then no more measurements.
            s, r = run.constants["s"], run.constants["r"]
            settled, last = s**2 / (2 * r), points[-1]
            mean, variance = rows[k * count][2], 0.01
            for i in range(1, count):
                mean, variance = mean * math.exp(-0.5 * r), settled + (variance - settled) * math.exp(-r)
                if i < first:
                    gain = variance / (variance + 0.01)
                    mean, variance = mean + gain * (rows[k * count + i][2] - mean), variance * (1 - gain)
            own = math.sqrt(variance + 0.01)
            assert abs(last.predicted - mean) < 0.02 and own * 0.99 < last.sd < 1.15 * own
            assert all(0.0 < point.ahead_sd < 1.15 * own for point in points)
    # Where the covariance is not kept, draws of what the fit does not determine stand for it.
    opened = open_run(tmp_path / "out5" / "folds" / "2")
    whole = table_of(path, opened.model)
    used, training = filter_run(opened, whole.subset([2]), 0, first), filter_run(opened, whole.subset([0, 1]), 0)
    (drawn,) = used.smoothed_after(training)
    assert np.allclose(drawn.measurement_sd[first:, 0], [point.sd for point in points], rtol=0.05)
