"""docs/studies.md is correct: its command lines are accepted, its cases exist, its links have targets."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gbspec.studies.options import StudyOptions
from gbspec.studies.tasks import study_of
from tests.cli.command_lines import accepted

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("line", re.findall(r"^gbspec .*$", TEXT, re.M))
def test_every_command_line_is_accepted(line: str) -> None:
    assert accepted(line)


def test_the_cases_that_it_names_are_there_and_have_what_it_says() -> None:
    study = study_of(["urp", "bf"], StudyOptions())
    training = {case.name: options for case, options in zip(study.cases, study.training, strict=True)}
    assert set(re.findall(r"`(\w+_PUBLISHED)`", TEXT)) == {name for name in training if name.endswith("_PUBLISHED")}
    assert training["BF_BB_A_PUBLISHED"].output_scale == 10000 and not training["BF_BB_A_PUBLISHED"].warm_start
    assert training["BF_BB_C_PUBLISHED"].random_substeps
    assert training["B_PUBLISHED"].max_step == 0.5


def test_every_link_leads_somewhere() -> None:
    assert all((ROOT / "docs" / target).exists() for target in re.findall(r"\]\(([^)#]+)\)", TEXT))
