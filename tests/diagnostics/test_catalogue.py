"""The catalogue of codes is complete: it has each code in use, and each code has an example that causes it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, Source, UserError
from gbspec.diagnostics.catalogue import all_codes, entries, explain
from gbspec.syntax.parser import parse

ROOT = Path(__file__).parents[2]
CODE = re.compile(r'"(GB\d{3})"')
SYNTAX = [
    code for code, entry in entries().items() if entry.topic == "syntax" and not entry.wrong.startswith("gbspec ")
]
GB_TOPICS = ("syntax", "names", "balances", "learning", "units", "contracts", "events", "delays")


def used_codes() -> dict[str, str]:
    """Every code in the package's source and the grammar's tables, with a file that has it."""
    files = [*ROOT.glob("gbspec/**/*.py"), ROOT / "grammar" / "mistakes.toml"]
    return {code: path.name for path in files for code in CODE.findall(path.read_text(encoding="utf-8"))}


def shown_codes() -> set[str]:
    """Every code that an expected diagnostic under tests/bad shows."""
    texts = (path.read_text(encoding="utf-8") for path in ROOT.glob("tests/bad/*/*.expected"))
    return {code for text in texts for code in re.findall(r"^(?:error|warning)\[(GB\d{3})\]", text, re.MULTILINE)}


def test_every_code_in_use_is_explained() -> None:
    missing = {code: file for code, file in used_codes().items() if code not in all_codes()}
    assert not missing


def test_every_code_of_the_language_has_a_wrong_file() -> None:
    of_files = {code for code, entry in entries().items() if entry.topic in GB_TOPICS}
    by_command = {code for code in of_files if explain(code).wrong.startswith("gbspec ")}
    assert of_files - by_command - shown_codes() == set()


def test_every_entry_says_something() -> None:
    for code, entry in entries().items():
        assert re.fullmatch(r"GB\d{3}", code)
        assert len(entry.explanation) > 40, code
        assert entry.wrong, code
        assert entry.right, code
        assert entry.wrong != entry.right, code
        assert entry.title[0].islower() or not entry.title[0].isalpha(), code
        assert not entry.title.endswith("."), code


@pytest.mark.parametrize("code", SYNTAX)
def test_the_wrong_text_gets_the_code_and_the_right_one_none(code: str) -> None:
    wrong, right = Findings(), Findings()
    parse(Source("wrong.gb", explain(code).wrong), wrong)
    parse(Source("right.gb", explain(code).right), right)
    assert {finding.code for finding in wrong} == {code}
    assert not list(right)


def test_explain_takes_any_case_and_suggests() -> None:
    assert explain(" gb116 ").code == "GB116"
    with pytest.raises(UserError) as caught:
        explain("GB11")
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB009"
    assert "did you mean `GB" in finding.help


@pytest.mark.parametrize(
    ("asked", "said"),
    [("GB999", "codes run from `GB0xx`"), ("GB729", "GB701 to GB728, GB730 to GB734"), ("XYZ", "such as `GB201`")],
)
def test_an_unknown_code_is_answered_with_the_known_ones(asked: str, said: str) -> None:
    with pytest.raises(UserError) as caught:
        explain(asked)
    assert said in caught.value.diagnostics[0].help
