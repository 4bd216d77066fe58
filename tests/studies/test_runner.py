"""A study from end to end: finished members are kept, interrupted ones go on, other settings are refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gbspec.cli.app import build
from gbspec.diagnostics import ComputationError, UserError
from gbspec.studies import member as members
from gbspec.studies import runner
from gbspec.studies.member import Place, fit_member
from gbspec.studies.options import StudyOptions
from gbspec.studies.record import read_record
from gbspec.studies.runner import check_settings, run_study
from gbspec.studies.tasks import Task, study_of

from .conftest import record


def tasks(cases: Path) -> list[Task]:
    return study_of([str(cases)], StudyOptions()).tasks()


def test_a_study_by_its_command_and_again(cases: Path) -> None:
    out = cases.parent / "out"
    arguments = ["study", f"{cases}:ONE", "-o", str(out), "--workers", "2", "--json"]
    first = CliRunner().invoke(build(["study"]), arguments)
    assert first.exit_code == 0, first.stderr
    document = json.loads(first.stdout)
    assert document["cases"]["ONE"]["members"] == 2 and document["cases"]["ONE"]["failed"] == []
    assert document["command"] == f"gbspec study {cases}:ONE -o {out}", "what made it, however it was worked off"
    assert {"solution", "rhs", "functions", "constants"} <= set(document["cases"]["ONE"]["metrics"])
    assert not (out / "runs").exists() and (out / "table.md").is_file()
    before = {path: path.read_text() for path in (out / "members" / "ONE").iterdir()}
    again = CliRunner().invoke(build(["study"]), arguments)
    assert again.exit_code == 0 and json.loads(again.stdout)["cases"] == document["cases"]
    assert {path: path.read_text() for path in (out / "members" / "ONE").iterdir()} == before
    other = CliRunner().invoke(build(["study"]), [*arguments, "--effort", "low"])
    assert other.exit_code == 1 and "GB820" in other.stderr


def test_a_member_is_continued_where_it_was_stopped(cases: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Training ended and the comparison was interrupted: the fit is taken up, not made again."""
    task, place = tasks(cases)[0], Place(cases.parent / "out")
    check = members.check

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(members, "check", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit_member(task, place)
    assert read_record(place.record(task)) is None and place.table(task).is_file()
    monkeypatch.setattr(members, "check", check)
    found = fit_member(task, place)
    assert found.resumed and found.failure is None and found.fitted is not None
    assert (found.fitted.errors["rhs"]["L2"] or 0) > 0
    assert not place.run(task).exists() and not place.table(task).exists()
    check_settings([task], place)
    with pytest.raises(UserError) as caught:
        check_settings([replace(task, seed=9)], place)
    assert caught.value.diagnostics[0].code == "GB820"


def test_what_cannot_be_fitted_is_a_result(cases: Path) -> None:
    cases.write_text(cases.read_text().replace("initial = { N = [0.5, 2] }", 'reject = ["N > 0"]'))
    task, place = tasks(cases)[0], Place(cases.parent / "out")
    found = fit_member(task, place)
    assert "drawn 200 times" in (found.failure or "") and read_record(place.record(task)) == found


def test_a_model_that_is_wrong_or_cannot_be_simulated_is_told_before_anything_is_fitted(cases: Path) -> None:
    model, text = cases.parent / "decay.gb", (cases.parent / "decay.gb").read_text()
    for wrong, code in ((text.replace("N' = -k*N", "N' = -k*M"), "GB201"), (text.split("truth")[0], "GB803")):
        model.write_text(wrong)
        result = CliRunner().invoke(build(["study"]), ["study", str(cases), "-o", str(cases.parent / "out")])
        assert result.exit_code == 1 and code in result.stderr
        assert not (cases.parent / "out" / "members").exists()


def test_a_directory_of_something_else_is_left_alone(cases: Path) -> None:
    shutil.copy(cases, cases.parent / "file")
    for to, code in ((cases.parent, "GB806"), (cases.parent / "file", "GB802")):
        result = CliRunner().invoke(build(["study"]), ["study", str(cases), "-o", str(to)])
        assert result.exit_code == 1 and code in result.stderr


def test_a_worker_that_dies_is_told_and_the_others_are_kept(cases: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Dead:
        exitcode = -9

        def is_alive(self) -> bool:
            return False

        def join(self) -> None: ...

        def terminate(self) -> None: ...

    def start(task: Task, place: Place, options: StudyOptions) -> Any:
        if task.member == 0:
            record(0, 1e-3, settings=task.settings).write(place.record(task))
        return Dead()

    monkeypatch.setattr(runner, "_start", start)
    with pytest.raises(ComputationError, match=r"ONE member 1 \(killed by signal 9\)"):
        run_study(study_of([f"{cases}:ONE"], StudyOptions()), cases.parent / "out", StudyOptions(), "", lambda *_: None)
    told = run_study(
        study_of([f"{cases}:ONE"], StudyOptions()),
        cases.parent / "out",
        StudyOptions(table_only=True),
        "gbspec study",
        lambda *_: pytest.fail("nothing is fitted"),
    )
    assert told.cases["ONE"].members == 1


def test_cases_that_differ_in_nothing_but_their_names_are_fitted_once(
    cases: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The paper has pairs of cases that only its own settings distinguish."""
    cases.write_text(cases.read_text() + '\n[case.AGAIN]\ntitle = "the first again"\nmodel = "decay"\n')
    fitted: list[str] = []

    def fit(waiting: list[Task], place: Place, options: StudyOptions, finished: Any) -> None:
        for task in waiting:
            fitted.append(task.name)
            made = record(task.member, 1e-3, settings=task.settings, seed=task.seed)
            made.write(place.record(task))
            finished(task, made)

    monkeypatch.setattr(runner, "_fit", fit)
    study, told = study_of([f"{cases}:ONE,AGAIN,TWO"], StudyOptions()), []
    out = cases.parent / "out"
    summary = run_study(study, out, StudyOptions(), "", lambda *arguments: told.append(arguments[2:]))
    assert fitted == ["ONE member 0", "TWO member 0", "ONE member 1"]
    assert told == [(2, 5), (3, 5), (5, 5)]
    assert summary.cases["AGAIN"].members == 2 and summary.cases["AGAIN"].fit_of == "ONE"
    assert "| AGAIN | the first again; the fits of ONE | 2 of 2 |" in (out / "table.md").read_text()
    fitted.clear()
    run_study(study, cases.parent / "kept", StudyOptions(keep_runs=True), "", lambda *_: None)
    assert len(fitted) == 5  # a run for each was asked for
