"""Errors one row ahead: the same rows and numbers in `train` and in `validate`, and of held-out rows alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.data import Trajectories, read
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.operations.analysing import validate
from gbspec.operations.evaluating import of_run
from gbspec.report import run_summary
from gbspec.report.html import tables
from gbspec.report.noises import learned_noises
from gbspec.report.text import likelihood_lines
from gbspec.report.verdict import verdict
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from gbspec.training.engines import filter
from tests.filter.conftest import BENT, engine_of, table

LEVEL = """model level
time t
state x in [0, 400]
learn s = 1 in [0, 20]
x' = 0
diffusion x = s
observe x
"""
QUICK = TrainOptions(effort="low", backend="torch", device="cpu")


def walk(rows: int = 40) -> Array:
    """Measurements of a random walk that begins far from the middle of its range."""
    rng = np.random.default_rng(3)
    return 30 + np.cumsum(rng.standard_normal(rows)) + 0.7 * rng.standard_normal(rows)


def fitted(folder: Path, text: str, rows: list[str], options: TrainOptions = QUICK) -> tuple[Run, Trajectories]:
    (folder / "m.gb").write_text(text, encoding="utf-8")
    (folder / "d.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    model = load_model(folder / "m.gb", Findings())
    data = read(folder / "d.csv", model, Findings())
    return train(model, data, options, folder / "run"), data


@pytest.fixture(scope="module")
def level(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Trajectories]:
    rows = ["t,x", *(f"{t},{x:.6f}" for t, x in enumerate(walk()))]
    return fitted(tmp_path_factory.mktemp("level"), LEVEL, rows)


def kalman(run: Run, y: Array) -> tuple[Array, Array]:
    """Predictions of all rows but the first from those before, and their standard deviations, by scalar formulas."""
    s, r = (run.fit.constants["s"].value or 0.0) ** 2, (run.fit.noise["x"] or 0.0) ** 2
    m, p, out = y[0], r, []
    for value in y[1:]:
        p += s
        out.append((m, np.sqrt(p + r)))
        gain = p / (p + r)
        m, p = m + gain * (value - m), p * (1 - gain)
    return np.array(out).T[0], np.array(out).T[1]


def test_train_and_validate_have_the_same_errors_one_row_ahead(level: tuple[Run, Trajectories]) -> None:
    run, data = level
    errors = walk()[1:] - kalman(run, walk())[0]
    rmse, r2 = float(np.sqrt(np.mean(errors**2))), 1 - np.mean(errors**2) / np.var(walk()[1:])
    one, channel = run.fit.members[0], (run.fit.members[0].channels or {})["x"]
    found = validate(run, data).ahead["1"]["x"]
    assert (found.n, channel.values) == (39, 39)
    # The scalar filter takes the first value for the start; this one has a wide prior around the range's middle.
    assert one.rmse["x"] == pytest.approx(rmse, rel=3e-3) and found.rmse == pytest.approx(one.rmse["x"], rel=1e-4)
    assert channel.r2 == pytest.approx(r2, abs=3e-3) and found.r2 == pytest.approx(channel.r2, rel=1e-4)
    assert one.loss is not None and one.loss == pytest.approx(0.5 * rmse**2 / np.var(walk()), rel=0.05)


def test_the_last_value_before_is_the_scale_of_errors_one_row_ahead(level: tuple[Run, Trajectories]) -> None:
    run, _ = level
    channel, y = (run.fit.members[0].channels or {})["x"], walk()
    assert channel.predictor == "the last value before"
    assert channel.naive == pytest.approx(1 - np.mean(np.diff(y) ** 2) / np.var(y[1:]))
    assert not any("one row ahead" in warning for warning in run.fit.warnings)


def test_predictions_that_are_worse_than_the_last_value_are_no_fit(tmp_path: Path) -> None:
    """A balance that decays at once predicts zero, whatever its disturbances."""
    rows = ["t,x", *(f"{t},{x:.6f}" for t, x in enumerate(walk()))]
    run, data = fitted(tmp_path, LEVEL.replace("x' = 0", "x' = -5*x"), rows)
    (said,) = [warning for warning in run.fit.warnings if "one row ahead" in warning]
    assert "one row ahead follow `x` worse than the last value before (R² -" in said and "do not rely" in said
    assert verdict(run, validate(run, data), [], with_data=True).headline.startswith("Do not rely")


def test_a_bound_that_makes_predictions_bad_is_named(tmp_path: Path) -> None:
    rows = ["t,x", *(f"{t},{x:.6f}" for t, x in enumerate(walk()))]
    text = LEVEL.replace("x' = 0", "x' = -r*x").replace("learn s = 1 in [0, 20]", "const s = 1\nlearn r = 4 in [3, 5]")
    run, _ = fitted(tmp_path, text, rows)
    (said,) = [warning for warning in run.fit.warnings if "one row ahead" in warning]
    assert "What may help: wider bounds of `r`, if values beyond them are plausible" in said


def test_the_last_values_are_those_of_each_channel_and_trajectory(tmp_path: Path) -> None:
    engine, _ = engine_of(tmp_path, BENT, table("X V y"))
    packed, last = engine.problem.packed, filter.last_values(engine)
    for i in range(packed.trajectories):
        rows = np.flatnonzero(packed.row_trajectory == i)
        rows = rows[np.argsort(packed.row_index[rows])]
        for j in range(last.shape[1]):
            earlier = rows[engine.problem.valued[rows, j]]
            assert np.array_equal(last[earlier[1:], j], engine.noise.value[earlier[:-1], j])
            assert np.isnan(last[earlier[0], j])


def test_held_out_rows_alone_make_the_held_out_r2(tmp_path: Path) -> None:
    rows = ["t,x", *(f"{t},{x:.6f}" for t, x in enumerate(walk()))]
    run, _ = fitted(tmp_path, LEVEL, rows, replace(QUICK, holdout=0.25))
    later, errors = walk()[30:], (walk()[1:] - kalman(run, walk())[0])[29:]
    channel = (run.fit.members[0].channels or {})["x"]
    assert channel.values == 29
    assert channel.held == pytest.approx(1 - np.mean(errors**2) / np.var(later), abs=1e-3)


def test_rows_before_the_first_measured_one_do_not_count(tmp_path: Path) -> None:
    """Nothing is measured in the first two rows, so that the third one is predicted from the start alone."""
    rows = ["t,x", "0,", "1,", *(f"{t},{x:.6f}" for t, x in enumerate(walk(20), start=2))]
    run, data = fitted(tmp_path, LEVEL, rows)
    found = validate(run, data)
    assert (run.fit.members[0].channels or {})["x"].values == found.ahead["1"]["x"].n == 19
    assert found.ahead["10"]["x"].n == 20 - 10
    assert found.ahead["1"]["x"].rmse == pytest.approx(run.fit.members[0].rmse["x"], rel=1e-3)


SLOPE = """model slope
time t
state x in [-10, 200]
state d in [-20, 20]
state e in [-0.1, 0.1]
learn s = 0.1 in [0.001, 20]
x' = d + e
d' = 0
e' = -e
diffusion x = s
observe x noise normal(0.05)
"""


def test_a_row_that_has_most_of_the_errors_is_told_and_counts(tmp_path: Path) -> None:
    """Before the second row nothing shows the slope; the errors further on are those of the noise."""
    rng = np.random.default_rng(1)
    line = 3 * np.arange(40.0) + 0.05 * rng.standard_normal((2, 40))
    run, _ = fitted(tmp_path, SLOPE, ["t,x", *(f"{t},{x:.6f}" for t, x in enumerate(line[0]))])
    (tmp_path / "new.csv").write_text("\n".join(["t,x", *(f"{t},{x:.6f}" for t, x in enumerate(line[1]))]) + "\n")
    new = read(tmp_path / "new.csv", run.model, Findings())
    found = validate(run, new)
    assert found.ahead["1"]["x"].n == 39 and found.ahead["1"]["x"].rmse > 0.4
    one, ten = (text for text in found.warnings if text.startswith("one row has"))
    assert "`x` 1 row ahead: t = 1, measured row 2 of trajectory" in one and "an uncertain one" in one
    assert "`x` 10 rows ahead: t = 10, measured row 11 of trajectory" in ten
    assert float(one.rsplit(" ", 1)[1]) < 0.2
    (said,) = [text for text in found.warnings if "were estimated" in text]
    assert "the errors of solutions from the start alone" in said and "a first guess of the start" in said


def test_a_prediction_one_row_ahead_uses_no_value_of_its_own_row(tmp_path: Path) -> None:
    """Innovations are given the earlier channels of their row; these errors are not, under log-normal noise too."""
    engine, vector = engine_of(tmp_path, BENT, table("X V y"))
    found = engine.filtered(vector)
    errors, counted = filter.one_row_ahead(engine, found)
    ahead = filter.steps_ahead(engine, vector, found, 1)
    values, log = engine.problem.packed.values, engine.noise.log
    with np.errstate(invalid="ignore"):
        expected = np.where(log, np.log(values / np.where(log, ahead, 1.0)), values - ahead)
    assert np.array_equal(counted, engine.problem.valued & np.isfinite(ahead)) and counted.sum() > 30
    assert errors[counted] == pytest.approx(expected[counted], rel=1e-6, abs=1e-9)
    assert not np.allclose(errors[counted], found.error[counted])


def test_the_worst_row_is_one_of_predictions_one_row_ahead(level: tuple[Run, Trajectories], tmp_path: Path) -> None:
    """A jump in the middle is the worst row; by the noise of measurement alone it would be one far from the start."""
    run, _ = level
    y = walk()
    y[25] += 8.0
    (tmp_path / "d.csv").write_text("t,x\n" + "".join(f"{t},{x:.6f}\n" for t, x in enumerate(y)))
    found = validate(run, read(tmp_path / "d.csv", run.model, Findings()))
    predicted, sd = kalman(run, y)
    assert found.worst is not None and (found.worst.time, found.worst.ahead, found.worst.of_noise) == (25.0, 1, None)
    assert found.worst.predicted == pytest.approx(predicted[24], abs=0.02)
    assert found.worst.of_prediction == pytest.approx(abs(y[25] - predicted[24]) / sd[24], rel=1e-2)
    assert "standard deviations of such predictions" in str(found.worst) and "noise" not in str(found.worst)
    assert {"ahead", "of_prediction", "deviations"} <= set(json.loads(json.dumps(found.to_json()))["worst"])


def test_rows_ahead_come_first_and_whole_solutions_are_named(level: tuple[Run, Trajectories]) -> None:
    found = validate(*level)
    lines = str(found).split("\n")
    assert lines[0].startswith("rows ahead") and lines[4].startswith("solutions from the start alone")
    assert lines[5].startswith("channel ")
    assert f"R² {found.ahead['1']['x'].r2:.5g} of x one row ahead" in found.summary()
    assert found.notes()[0].startswith("the table above: solutions from the start alone")
    assert not any("does not follow the rows" in one for one in found.warnings)


def test_the_learned_noise_stands_beside_the_constants(level: tuple[Run, Trajectories]) -> None:
    run, data = level
    (line,) = [line for line in run_summary(run).split("\n") if line.startswith("noise of x")]
    record = run.fit.members[0].likelihood
    assert record is not None and record.noise["x"].interval is not None
    low, high = record.noise["x"].interval
    assert f"{record.noise['x'].value:.6g}" in line and f"{low:.4g} to {high:.4g}" in line
    for made in (tables.constants(run), tables.few_constants(run)):
        assert [row[0] for row in made.rows] == ["s", "noise of x"]
    assert [line[:18] for line in likelihood_lines(run)] == ["-2 log likelihood "]
    states = tuple(replace(state, unit="mg/L") for state in run.model.states)
    (noise,) = learned_noises(replace(run, model=replace(run.model, states=states)))
    assert noise.unit == "mg/L", "the unit is that of the state"
    errors = tables.metrics(validate(run, data).to_json())
    assert list(errors)[:3] == [
        "on the data, 1 row ahead",
        "on the data, 10 rows ahead",
        "on the data, from the start alone, without disturbances",
    ]


def test_a_report_judges_disturbed_models_one_row_ahead(level: tuple[Run, Trajectories]) -> None:
    """Whole solutions have a negative R² here, which says nothing of the model; innovations are independent."""
    run, data = level
    found = validate(run, data)
    judged = verdict(run, found, [], with_data=True)
    assert found.channels["x"].r2 < found.ahead["1"]["x"].r2 < 0.5
    assert judged.headline == "It follows the data in part."
    assert any("Predictions one row ahead follow `x` in part" in one for one in judged.doubt)


def test_slopes_in_sizes_of_disturbances_are_explained(level: tuple[Run, Trajectories], tmp_path: Path) -> None:
    run, data = level
    assert not of_run(run, data).remark, "with nothing else estimated both likelihoods have one maximum"
    drift = LEVEL.replace("x' = 0", "learn a = 0.1 in [-5, 5]\nx' = a")
    run, data = fitted(tmp_path, drift, ["t,x", *(f"{t},{x:.6f}" for t, x in enumerate(walk()))])
    found = of_run(run, data)
    assert "sizes of disturbances (s)" in found.remark and str(found).endswith(found.remark)
    assert abs(found.gradient["a"]) < 0.01 < abs(found.gradient["s"])
    assert not of_run(run, data, {"s": 2.0}).remark
