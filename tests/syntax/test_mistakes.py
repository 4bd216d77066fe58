"""Likely mistakes: each gets one diagnostic, with its code, at the right place; every entry of the table is used."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, Source, Span
from gbspec.syntax import mistakes
from gbspec.syntax.grammar import engine
from gbspec.syntax.parser import parse, parse_expression
from tests.texts import model_of

ROOT = Path(__file__).parents[2]
SLIPS = [line.split("\t") for line in (Path(__file__).parent / "slips.tsv").read_text("utf-8").splitlines()[1:]]
LONE = [("GB117", "x = 3"), ("GB121", "0 < x < 1"), ("GB141", "x > 1, y > 2"), ("GB118", "x => 3"), ("GB119", "x && y")]
BEFORE, AFTER = "state X\nstate x\n", "let after = 3\n"


def findings_of(text: str) -> Findings:
    findings = Findings()
    parse(Source("test.gb", text), findings)
    return findings


@pytest.mark.parametrize(("code", "marked", "slip"), SLIPS, ids=[slip for _, _, slip in SLIPS])
def test_a_mistake_is_one_diagnostic_at_its_place(code: str, marked: str, slip: str) -> None:
    (finding,) = findings_of(f"{BEFORE}{slip}\n{AFTER}")
    assert finding.code == code
    assert isinstance(finding.place, Span)
    assert finding.place.text == marked
    assert finding.place.position[0] == 3
    assert finding.help or finding.label


@pytest.mark.parametrize(("code", "slip"), LONE)
def test_a_mistake_in_a_lone_expression(code: str, slip: str) -> None:
    findings = Findings()
    assert parse_expression(Source("--reject", slip), findings) is None
    assert [finding.code for finding in findings] == [code]
    assert "statement" not in "".join(finding.message + finding.label for finding in findings)


def test_no_message_shows_terminals_of_the_grammar() -> None:
    terminals = {terminal.name for terminal in engine()[0].terminals}
    shouting = {name for name in terminals if len(name) > 2 and name not in {"AND", "NOT"}}
    for _, _, slip in SLIPS:
        (finding,) = findings_of(f"{BEFORE}{slip}\n")
        said = f"{finding.message} {finding.label} {finding.help}".replace(slip, "")
        words = {word.strip("`'\",.:;()") for word in said.split()} - {"NAME", "STATE"}
        assert not words & shouting, finding.message


def test_every_entry_of_the_table_applies_to_some_mistake(monkeypatch: pytest.MonkeyPatch) -> None:
    spoken: list[mistakes.Mistake] = []
    say = mistakes._say
    monkeypatch.setattr(mistakes, "_say", lambda mistake, slip: (spoken.append(mistake), say(mistake, slip))[1])
    for _, _, slip in SLIPS:
        findings_of(f"{BEFORE}{slip}\n{AFTER}")
    for _, slip in LONE:
        parse_expression(Source("test", slip), Findings())
    for path in ROOT.glob("tests/bad/syntax/*.gb"):
        findings_of(path.read_text(encoding="utf-8"))
    assert [entry.message for entry in mistakes.table(engine()[0]).entries if entry not in spoken] == []


def test_the_diagnostic_does_not_depend_on_the_preceding_text() -> None:
    slip = "let a = 2x\n"
    messages = set()
    for before in ("", "model m\n", "state y\n" * 50, "unknown f(u)\n  >= 0\n"):
        (finding,) = findings_of(before + slip)
        messages.add((finding.code, finding.message, finding.help))
    assert len(messages) == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("state Y\nY = 3\n", "write `Y' = …`"),
        ("learn Y = 1\nY = 3\n", "write `let Y = …`"),
        ("Y = 3\nstate Y\n", "write `Y' = …`"),
        ("stat Y\n", "did you mean `state`?"),
        ("observe y nose normal(3)\n", "did you mean `noise`?"),
    ],
)
def test_help_takes_the_rest_of_the_file_into_account(text: str, said: str) -> None:
    (finding,) = findings_of(text)
    assert said in finding.help


@pytest.mark.parametrize(
    ("declared", "lines"),
    [
        ("q(T - x)", ["let q_argument = T - x", "unknown q(q_argument)"]),
        ("q(2*x)", ["let q_argument = 2*x", "unknown q(q_argument)"]),
        ("q(log(x))", ["let q_argument = log(x)", "unknown q(q_argument)"]),
        ("q(x, (x + 1)*T^2, T)", ["let q_argument = (x + 1)*T^2", "unknown q(x, q_argument, T)"]),
    ],
)
def test_an_expression_as_an_argument_leads_to_lines_that_are_right(declared: str, lines: list[str]) -> None:
    before, after = "state x in [1, 9]\ninput T held\n", "x' = -q\nobserve x\n"
    (finding,) = findings_of(f"{before}unknown {declared} >= 0 by mlp(8)\n{after}")
    assert finding.code == "GB159"
    assert finding.help.split("write ")[1] == " and ".join(f"`{line}`" for line in lines)
    model_of(f"model m\n{before}{lines[0]}\n{lines[1]} >= 0 by mlp(8)\n{after}")


def test_what_was_expected_is_said_in_the_user_s_words() -> None:
    (finding,) = findings_of("time t : h from\n")
    assert finding.label == "expected an expression"
    (finding,) = findings_of("model a model\n")
    assert finding.label == "expected a text in quotes, the end of the statement or `extends`"
