"""The tables: statistics over members, and numbers beside the published ones."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

import gbspec
from gbspec.analysis.validation.metrics import ChannelErrors
from gbspec.analysis.validation.step_check import StepCheck
from gbspec.analysis.validation.validate import TrajectoryError, Validation
from gbspec.studies.member import Place, errors_of
from gbspec.studies.options import StudyOptions
from gbspec.studies.record import Record, read_record
from gbspec.studies.tables import member_statistics, write_tables
from gbspec.studies.tasks import study_of

from .conftest import record


def test_statistics_of_numbers() -> None:
    found = member_statistics([3.0, 1.0, 2.0])
    assert (found.mean, found.sd, found.median, found.worst) == (2.0, 1.0, 2.0, 3.0)
    assert member_statistics([1.0, 3.0]).median == 2.0


def test_a_failed_member_is_the_worst_and_voids_the_mean() -> None:
    found = member_statistics([1.0, math.inf, 2.0])
    assert (found.mean, found.median, found.worst) == (math.inf, 2.0, math.inf)


def test_tables_of_what_is_there(cases: Path) -> None:
    study = study_of([str(cases)], StudyOptions(members=3))
    place = Place(cases.parent / "out")
    one, _, two, *_ = study.tasks()
    record(0, 1e-3).write(place.record(one))
    record(1, 4e-3, step_warning="it depends on the step", resumed=True).write(place.record(two))
    summary = write_tables(study, place, "gbspec study here")
    written = json.loads((place.root / "study.json").read_text())
    case = written["cases"]["ONE"]
    assert (case["members"], case["planned"], case["failed"], case["step_warnings"]) == (2, 3, [], [1])
    assert case["metrics"]["solution"]["L2"] == {"mean": 2.5e-3, "sd": pytest.approx(2.1213e-3, rel=1e-4),
                                                 "median": 2.5e-3, "worst": 4e-3}  # fmt: skip
    assert case["metrics"]["constants"] == {"published": 0.1}  # published, but not reached by any member yet
    assert case["cpu_seconds"] == {"median": 10.0, "most": 10.0, "members": 1}  # the resumed one has not all its time
    assert written["cases"]["TWO"]["members"] == 0 and summary.command == "gbspec study here"
    text = (place.root / "table.md").read_text()
    assert "| ONE | solution | 1.00e-02 | 2.50e-03 ± 2.12e-03 | 2.50e-03 | 4.00e-03 | 4 | 2.5 |" in text
    rows = list(csv.DictReader(io.StringIO((place.root / "results.csv").read_text())))
    assert [(row["case"], row["member"], row["solution_L1"], row["constant_k"]) for row in rows] == [
        ("ONE", "0", "0.002", "0.7"),
        ("ONE", "1", "0.008", "0.7"),
    ]


def test_a_failure_is_told(cases: Path) -> None:
    study = study_of([f"{cases}:ONE"], StudyOptions(members=2))
    place = Place(cases.parent / "out")
    first, second = study.tasks()
    record(0, 1e-3).write(place.record(first))
    failed = Record(case="ONE", member=1, seed=1, settings="", finished="2026", machine="here", failure="it blew up")
    failed.write(place.record(second))
    write_tables(study, place, "gbspec study")
    text = (place.root / "table.md").read_text()
    assert "| ONE | solution | 1.00e-02 | failed | failed | failed |  |  |" in text
    assert "| ONE | the first | 2 of 2 | 1 | 0 | 10 (10) |" in text
    assert "it blew up" in (place.root / "results.csv").read_text()


def test_from_python(cases: Path) -> None:
    found = gbspec.study(str(cases), cases.parent / "out", table_only=True)
    assert found["cases"]["ONE"]["members"] == 0 and (cases.parent / "out" / "table.md").is_file()


def test_without_a_truth_the_errors_are_those_on_the_data() -> None:
    channels = {"N": ChannelErrors(4, 1.0, 0.2, 1.0, 1.0), "M": ChannelErrors(4, 1.0, 0.4, 1.0, 1.0)}
    trajectory = TrajectoryError("1", 0.3, "learned")
    found = Validation(0, channels, (trajectory,), StepCheck(None, None))
    assert errors_of(found) == {"data": {"L2": pytest.approx(0.3), "failed": 0}}
    unsolved = replace(found, trajectories=(trajectory, TrajectoryError("2", math.nan, "failed", "it blew up")))
    assert errors_of(unsolved)["data"]["failed"] == 1


STORED = sorted((Path(__file__).parents[2] / "docs" / "studies").glob("*/members/*/*.json"))


@pytest.mark.parametrize(
    "folder", sorted({path.parent for path in STORED}), ids=lambda path: "/".join(path.parts[-3::2])
)
def test_a_stored_record_is_written_as_it_was_read(folder: Path, tmp_path: Path) -> None:
    """Those of the first version lack `step_check.unsolved`, which has a default; else not a character differs."""
    for path in folder.iterdir():
        found = read_record(path)
        assert found is not None and found.fitted is not None
        found.write(tmp_path / "again.json")
        again = json.loads((tmp_path / "again.json").read_text())
        before = json.loads(path.read_text())
        before["step_check"].setdefault("unsolved", 0)
        assert json.dumps(again) == json.dumps(before)


def test_keys_of_a_record_are_in_the_order_of_the_first_version(tmp_path: Path) -> None:
    kept = {"settings": "s", "resumed": False, "finished": "2026", "failure": "it blew up", "machine": "here"}
    failed = {"case": "ONE", "member": 1, "seed": 1, **kept, "fit_of": "TWO"}
    (tmp_path / "1.json").write_text(json.dumps(failed))
    found = read_record(tmp_path / "1.json")
    assert found is not None and found.fitted is None and found.failure == "it blew up"
    assert list(found.to_json().items()) == list(failed.items())


@pytest.mark.parametrize("wrong", ["", "[]", "{}", '{"case": "ONE", "member": 0, "seed": 0, "settings": "s"}'])
def test_a_damaged_record_counts_as_none(wrong: str, tmp_path: Path) -> None:
    (tmp_path / "0.json").write_text(wrong)
    assert read_record(tmp_path / "0.json") is None and read_record(tmp_path / "1.json") is None
