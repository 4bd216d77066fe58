"""Sweeps: options are crossed, each combination is a run that can be used and resumed, and a table has them all."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from gbspec.diagnostics import Findings, UserError
from gbspec.runs import open_run
from gbspec.training import TrainOptions, train
from gbspec.training.runs.sweep import sweep
from gbspec.training.runs.variations import points
from tests.training.conftest import URP, Recorder, model_of, urp_data

pytestmark = pytest.mark.usefixtures("quick_fits")

BASE = TrainOptions(method="lm", epochs=2, warm_start=False, workers=1, max_step=0.2)


def chosen(*texts: str) -> list[tuple[str, TrainOptions]]:
    findings = Findings()
    out = [(point.name, point.options) for point in points(texts, BASE, findings)]
    findings.raise_if_failed()
    return out


def table(place: Path) -> list[dict[str, str]]:
    with (place / "sweep" / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def test_options_are_crossed_and_read_as_their_types() -> None:
    found = chosen("max-step=0.05,0.1", "effort=low, high", "half_step=true")
    assert [name for name, _ in found] == [
        "max_step=0.05,effort=low,half_step=true",
        "max_step=0.05,effort=high,half_step=true",
        "max_step=0.1,effort=low,half_step=true",
        "max_step=0.1,effort=high,half_step=true",
    ]
    assert found[3][1].max_step == 0.1 and found[3][1].effort == "high" and found[3][1].half_step is True
    assert found[0][1].method == "lm", "what is not varied is as given"


@pytest.mark.parametrize(
    ("texts", "codes"),
    [
        ([], ["GB862"]),
        (["efort=low"], ["GB862"]),
        (["workers=1,2"], ["GB862"]),
        (["epochs=few"], ["GB862"]),
        (["epochs="], ["GB862"]),
        (["half_step=perhaps"], ["GB862"]),
        (["epochs=1,1", "effort=low", "effort=high"], ["GB862", "GB862"]),
        (["effort=some,low", "holdout=2"], ["GB850", "GB850"]),
    ],
)
def test_what_makes_no_sense_is_said(texts: list[str], codes: list[str]) -> None:
    findings = Findings()
    points(texts, BASE, findings)
    assert [diagnostic.code for diagnostic in findings] == codes


def test_a_sweep_is_its_runs_and_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    findings = Findings()
    grid = points(["max_step=0.1,0.2", "seed=3,4"], BASE, findings)
    recorder = Recorder(interrupt_after=5)
    with pytest.raises(KeyboardInterrupt):
        sweep(model, data, grid, BASE, tmp_path / "sweep", recorder)
    assert [row["members"] for row in table(tmp_path)] == ["1", "1", "0", "0"], "the second one is unfinished"
    again = points(["max_step=0.1,0.2", "seed=3,4"], TrainOptions(**BASE.to_json(), resume=True), findings)
    rows = sweep(model, data, again, TrainOptions(workers=1), tmp_path / "sweep")
    assert [row.numbers["members"] for row in rows] == [1] * 4
    alone = train(model, data, grid[2].options, tmp_path / "alone")
    swept = open_run(tmp_path / "sweep" / "max_step=0.2,seed=3")
    assert swept.fit.options["max_step"] == 0.2
    expected = ("strongly correlated", "R²", "no intervals")
    assert all(any(words in warning for words in expected) for warning in swept.fit.warnings)
    for name, value in alone.member().weights.items():
        assert np.array_equal(swept.member().weights[name], value), name
    written = table(tmp_path)
    assert [row["run"] for row in written] == [point.name for point in grid]
    assert float(written[2]["loss"]) == alone.fit.members[0].loss == rows[2].numbers["loss"]
    assert float(written[2]["beta"]) == alone.fit.constants["beta"].value


def test_a_sweep_that_goes_on_may_have_new_values(tmp_path: Path) -> None:
    model, data, findings = model_of(URP), urp_data(4, 2.0, 6), Findings()
    sweep(model, data, points(["seed=3"], BASE, findings), BASE, tmp_path / "sweep")
    more = points(["seed=3,4"], TrainOptions(**BASE.to_json(), resume=True), findings)
    assert [row.numbers["members"] for row in sweep(model, data, more, BASE, tmp_path / "sweep")] == [1, 1]


def test_a_sweep_that_is_refused_has_begun_nothing(tmp_path: Path) -> None:
    findings = Findings()
    base = TrainOptions(effort="low", workers=1)
    wrong = points(["stages=teacher-forcing,half-step"], base, findings)
    with pytest.raises(UserError, match="there is no stage `half step`"):
        sweep(model_of(URP), urp_data(4, 2.0, 6), wrong, base, tmp_path / "sweep")
    assert not (tmp_path / "sweep").exists()
