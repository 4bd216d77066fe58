"""What a study has to do: cases by their names, settings from case and command line, the order by member."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.data.shipped import models_folder
from gbspec.diagnostics import UserError
from gbspec.studies.options import StudyOptions
from gbspec.studies.tasks import study_of


def code_of(texts: list[str], options: StudyOptions = StudyOptions()) -> str:  # noqa: B008 - it is frozen
    with pytest.raises(UserError) as caught:
        study_of(texts, options)
    return caught.value.diagnostics[0].code


def test_every_case_has_its_first_member_before_any_has_its_second(cases: Path) -> None:
    tasks = study_of([str(cases)], StudyOptions(seed=5)).tasks()
    assert [(task.case.name, task.member, task.seed) for task in tasks] == [("ONE", 0, 5), ("TWO", 0, 5), ("ONE", 1, 6)]
    more = study_of([str(cases.parent)], StudyOptions(members=3)).tasks()
    assert [task.member for task in more] == [0, 0, 1, 1, 2, 2]


def test_cases_are_chosen_by_name(cases: Path) -> None:
    assert [c.name for c in study_of([f"{cases}:two"], StudyOptions()).cases] == ["TWO"]
    assert [c.name for c in study_of([str(cases)], StudyOptions(case=("one",))).cases] == ["ONE"]
    assert [c.name for c in study_of(["urp:A,F", "bf:BF_BB"], StudyOptions()).cases] == ["A", "F", "BF_BB"]
    assert code_of([f"{cases}:THREE"]) == "GB743"
    assert code_of([str(cases)], StudyOptions(case=("THREE",))) == "GB743"
    assert code_of(["upr"]) == "GB801"
    assert code_of([str(cases), f"{cases}:ONE"]) == "GB820"


def test_the_flags_that_results_depend_on() -> None:
    assert StudyOptions(workers=2, threads=3, table_only=True).flags() == []
    chosen = StudyOptions(case=("A", "B"), members=3, seed=7, effort="high", noise=0.05)
    assert " ".join(chosen.flags()) == "--case A --case B --members 3 --effort high --noise 0.05 --seed 7"


def test_options_of_the_command_line_go_before_those_of_the_case(cases: Path) -> None:
    (plain,) = study_of([f"{cases}:TWO"], StudyOptions()).tasks()
    assert (plain.case.sampling.noise, plain.training.effort, plain.training.method) == (
        0.1,
        "normal",
        "lm",
    )
    (other,) = study_of([f"{cases}:TWO"], StudyOptions(effort="low", noise=0.0)).tasks()
    assert (other.case.sampling.noise, other.training.effort) == (0.0, "low")


def test_what_a_result_depends_on_changes_its_settings_and_nothing_else_does(cases: Path) -> None:
    def settings(**options: object) -> str:
        return study_of([f"{cases}:ONE"], StudyOptions(**options)).tasks()[0].settings  # type: ignore[arg-type]  # by name

    before = settings()
    assert settings(seed=3, members=7, workers=2, threads=2) == before
    assert len({before, settings(effort="low"), settings(noise=0.1)}) == 3
    model = cases.parent / "decay.gb"
    model.write_text(model.read_text().replace("k = 0.5", "k = 0.4"))
    assert settings() != before


@pytest.mark.parametrize(
    ("entry", "code"),
    [("warm-strat = false", "GB741"), ("epochs = 2.5", "GB742"), ("ridge = -1", "GB742"), ("seed = 3", "GB741"),
     ("effort = 'huge'", "GB742")],
)  # fmt: skip
def test_training_that_cannot_be(cases: Path, entry: str, code: str) -> None:
    cases.write_text(f"{cases.read_text()}\n[case.BAD]\nmodel = 'decay'\n[case.BAD.training]\n{entry}\n")
    assert code_of([str(cases)]) == code


def test_a_case_with_a_table_reads_it(cases: Path) -> None:
    (cases.parent / "t.csv").write_text("trajectory,t,N\n1,0,1\n1,1,0.5\n")
    cases.write_text(cases.read_text() + 'data = "t.csv"\n')
    (task,) = study_of([f"{cases}:TWO"], StudyOptions()).tasks()
    assert task.case.data == cases.parent / "t.csv"
    cases.write_text(cases.read_text().replace("t.csv", "s.csv"))
    assert code_of([str(cases)]) == "GB742"


@pytest.mark.parametrize("wrong", [{"members": 0}, {"workers": 0}, {"noise": -0.1}, {"seed": -1}, {"threads": 0}])
def test_options_that_make_no_sense(cases: Path, wrong: dict[str, int]) -> None:
    assert code_of([str(cases)], StudyOptions(**wrong)) == "GB814"  # type: ignore[arg-type]  # one option by name


def test_all_published_cases_can_be_studied() -> None:
    study = study_of(["urp", "bf"], StudyOptions())
    assert len(study.cases) >= 17 and all(count == 10 for count in study.members)
    assert "BF_PRINTED" not in {case.name for case in study.cases}  # stiff and not published: only where it is named
    assert [c.name for c in study_of(["bf"], StudyOptions(case=("BF_PRINTED",))).cases] == ["BF_PRINTED"]
    by_name = dict(zip((case.name for case in study.cases), study.training, strict=True))
    assert by_name["URP_GB2"].max_step is None  # the same defaults for all that do not ask for the paper's own settings
    assert (models_folder() / "urp" / "cases.toml").is_file()
