"""What `fit.json` says: the keys of the contract, strict reading, and files of version 0.1.0."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gbspec.diagnostics import Findings, UserError
from gbspec.operations.tables import training_data
from gbspec.report import collect
from gbspec.report.html import page, tables
from gbspec.report.text import run_summary
from gbspec.runs import open_run
from gbspec.runs.record import FitRecord, StepRecord, read_record
from gbspec.runs.store import Run
from gbspec.training import TrainOptions

VERSION_0_1_0 = Path(__file__).parent / "data" / "version_0_1_0"
DOCUMENT: dict[str, Any] = json.loads((VERSION_0_1_0 / "run" / "fit.json").read_text())
FOREIGN = ["abc", [1], [], None, 3, 1.5, -1, True, {"a": 1}, {}, 10**30]
"""JSON values of every type, of which most are wrong for any key."""
CONTRACT = ["gbspec", "model", "data", "options", "versions", "constants", "noise", "members", "warnings"]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(VERSION_0_1_0 / "run", tmp_path / "run"))


def places(value: object, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The place of every key and entry in a document."""
    if path:
        yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in entries:
        yield from places(item, (*path, key))


def changed(path: tuple[Any, ...], value: object, remove: bool = False) -> dict[str, Any]:
    """The document with another value at a place, or without it."""
    document: Any = json.loads(json.dumps(DOCUMENT))
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    if remove:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return document  # type: ignore[no-any-return]  # JSON


def used(run: Run) -> None:
    """What reads the record: the summary, the report's parts, the options of a profile."""
    run_summary(run)
    collect.constants(run)
    tables.correlations(run)
    page._reproduce(run)
    training_data(run, Findings(), required=False)
    assert run.best in run.numbers
    assert FitRecord.to_json(run.fit)["gbspec"] == run.fit.gbspec
    with contextlib.suppress(UserError):
        TrainOptions.recorded(run.fit.options, run.path)


def test_every_key_with_json_of_every_other_type(run: Path) -> None:
    """Either every wrong key is told with what was expected, or the run can be read and used."""
    opened = open_run(run)
    refused = readable = 0
    for path in places(DOCUMENT):
        for value in FOREIGN:
            (run / "fit.json").write_text(json.dumps(changed(path, value)))
            findings = Findings()
            record = read_record(run, findings)
            if record is not None:
                readable += 1
                used(replace(opened, fit=record))
                continue
            refused += 1
            assert {finding.code for finding in findings} == {"GB852"}
            last = path[-1] if isinstance(path[-1], str) else f"[{path[-1]}]"
            assert any(last in finding.message and "expected" in finding.message for finding in findings)
    assert refused > 2 * readable > 0


@pytest.mark.parametrize("path", [p for p in places(DOCUMENT) if isinstance(p[-1], str)], ids=str)
def test_a_missing_key_is_named_unless_it_has_a_default(run: Path, path: tuple[Any, ...]) -> None:
    (run / "fit.json").write_text(json.dumps(changed(path, None, remove=True)))
    in_table = len(path) > 1 and path[0] in ("options", "versions", "noise", "correlations")
    if in_table or path[-1] in ("k", "b", "x", "correlations", "step_checks", "unsolved"):
        used(open_run(run))
        return
    with pytest.raises(UserError) as caught:
        open_run(run)
    assert f"{path[-1]}` is missing; expected" in caught.value.diagnostics[0].message


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"gbspec": NaN}', "NaN is not a number"),
        ('{"gbspec": -Infinity}', "-Infinity is not a number"),
        ('{"gbspec": "\\ud800"}', "surrogates"),
        ("[" * 100_000, "recursion"),
        ("1" * 5000, "digits"),
        ("[1, 2]", "a list of 2; expected an object"),
        ('"text"', '"text"; expected an object'),
        ("", "Expecting value"),
    ],
)
def test_what_is_no_document(run: Path, text: str, said: str) -> None:
    (run / "fit.json").write_text(text)
    with pytest.raises(UserError) as caught:
        open_run(run)
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB852" and said in finding.message


def test_bytes_that_are_no_text_and_a_number_too_large(run: Path) -> None:
    (run / "fit.json").write_bytes(b"\xff\xfe{}")
    with pytest.raises(UserError, match="GB852"):
        open_run(run)
    text = json.dumps(changed(("members", 0, "loss"), "HERE")).replace('"HERE"', "1e999")
    (run / "fit.json").write_text(text)
    with pytest.raises(UserError, match=r"members\[0\]\.loss` is .*expected a number or null"):
        open_run(run)


def test_all_that_is_wrong_is_told_at_once(run: Path) -> None:
    document = changed(("data", "rows"), "many")
    del document["noise"]
    document["constants"]["k"]["interval"] = [1.0]
    (run / "fit.json").write_text(json.dumps(document))
    with pytest.raises(UserError) as caught:
        open_run(run)
    said = [d.message.partition("damaged: ")[2] for d in caught.value.diagnostics]
    assert said == [
        '`data.rows` is "many"; expected a whole number',
        "`constants.k.interval` is a list of 1; expected a list of 2 or null",
        "`noise` is missing; expected an object",
    ]


def test_a_file_of_version_0_1_0_reads_with_defaults_and_is_written_as_it_was(run: Path) -> None:
    fit = open_run(run).fit
    assert fit.interface == 1
    assert fit.data.path == "data.csv" and fit.constants["k"].interval is not None
    assert list(fit.to_json()) == [*CONTRACT, "correlations", "solver", "step_checks", "interface", "finished"]
    assert fit.to_json() == DOCUMENT | {"solver": "rk4", "interface": 1, "finished": True}


def test_unknown_keys_are_kept_at_every_level(run: Path) -> None:
    document = changed(("purpose",), {"interval": 1.5, "whole": None})
    document["members"][0]["device"] = "cpu"
    document["members"][0]["stages"][0]["accepted"] = [1, 2]
    (run / "fit.json").write_text(json.dumps(document))
    opened = open_run(run)
    check = StepRecord(None, None, 0.1, 2)
    amended = opened.amended(replace(opened.fit, step_checks=(check,)))
    written = json.loads((run / "fit.json").read_text())
    assert written["purpose"] == {"interval": 1.5, "whole": None}
    assert written["members"] == document["members"]
    assert written["step_checks"][0]["half_step"] is None
    assert open_run(run).fit == amended.fit


def test_options_of_a_record_are_those_of_the_training() -> None:
    fit = read_record(VERSION_0_1_0 / "run", Findings())
    assert fit is not None
    expected = TrainOptions(effort="low", threads=1, workers=1)
    assert TrainOptions.recorded(fit.options, VERSION_0_1_0) == expected
    assert TrainOptions.recorded({**fit.options, "of_later": 1}, VERSION_0_1_0) == expected
    assert TrainOptions.recorded({}, VERSION_0_1_0) == TrainOptions()
    with pytest.raises(UserError, match=r'options\.effort` is "most"; expected one of "low", "normal", "high"'):
        TrainOptions.recorded({**fit.options, "effort": "most"}, VERSION_0_1_0)


def test_the_largest_seed_that_trains_is_read_again(run: Path) -> None:
    """torch takes seeds below 2**64, so a run may have been trained with one."""
    document = changed(("options", "seed"), 2**64 - 1)
    document["members"][0]["seed"] = 2**64 - 1
    (run / "fit.json").write_text(json.dumps(document), encoding="utf-8")
    assert open_run(run).fit.members[0].seed == 2**64 - 1
