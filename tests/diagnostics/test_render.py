"""The text and the JSON of diagnostics."""

from __future__ import annotations

import json

import pytest

from gbspec.diagnostics import Cell, Diagnostic, Findings, Label, Severity, Source, Span
from gbspec.diagnostics.render import display_width, printable, render_text, summary, to_json

FERMENTER = Source("models/fermenter.gb", "\n" * 7 + "learn k = 1\nunknown mu(S) : 1/h\nX' = k*mu(S)*X - D*X\n")


def span(source: Source, text: str) -> Span:
    start = source.text.index(text)
    return Span(source, start, start + len(text))


def example() -> Diagnostic:
    return Diagnostic(
        "GB401",
        "`k` and `mu` cannot be told apart by any data",
        span(FERMENTER, "k*mu(S)"),
        "they occur only as this product",
        (
            Label(span(FERMENTER, "k"), "learnable constant"),
            Label(span(FERMENTER, "mu"), "unknown function with free scale"),
        ),
        ("k -> c*k, mu -> mu/c leaves every balance and observation unchanged",),
        "remove `k`, give it a value, or bound `mu`; or accept it with `allow GB401`",
        severity=Severity.WARNING,
    )


def test_several_places_of_one_diagnostic_in_one_excerpt() -> None:
    assert render_text([example()]) == (
        "warning[GB401]: `k` and `mu` cannot be told apart by any data\n"
        "  --> models/fermenter.gb:10:6\n"
        "   |\n"
        " 8 | learn k = 1\n"
        "   |       - learnable constant\n"
        " 9 | unknown mu(S) : 1/h\n"
        "   |         -- unknown function with free scale\n"
        "10 | X' = k*mu(S)*X - D*X\n"
        "   |      ^^^^^^^ they occur only as this product\n"
        "   |\n"
        "   = note: k -> c*k, mu -> mu/c leaves every balance and observation unchanged\n"
        "   = help: remove `k`, give it a value, or bound `mu`; or accept it with `allow GB401`\n"
    )


def test_color_changes_nothing_but_escape_sequences() -> None:
    import re

    colored = render_text([example()], color=True)
    assert "\x1b[1;33m" in colored
    assert re.sub(r"\x1b\[[0-9;]*m", "", colored) == render_text([example()])


def test_lines_between_places_are_left_out_except_a_single_one() -> None:
    source = Source("a.gb", "one\ntwo\nthree\nfour\nfive\nsix\nseven")
    finding = Diagnostic("GB201", "m", span(source, "one"), "", (Label(span(source, "three"), "a"),))
    assert "2 | two" in render_text([finding])
    far = Diagnostic("GB201", "m", span(source, "one"), "", (Label(span(source, "seven"), "a"),))
    assert "...\n7 | seven" in render_text([far])
    assert "two" not in render_text([far])


def test_a_place_in_another_file_gets_a_separate_excerpt() -> None:
    base = Source("base.gb", "learn k = 1\n")
    finding = Diagnostic("GB202", "m", span(FERMENTER, "learn k"), "again", (Label(span(base, "k"), "first"),))
    text = render_text([finding])
    assert " --> models/fermenter.gb:8:1" in text
    assert " ::: base.gb:1:7\n  |\n1 | learn k = 1\n  |       - first" in text


@pytest.mark.parametrize(
    ("line", "marked", "before"),
    [
        ("state 生物 x", "x", 11),  # two columns each
        ("let x\u0301y = z", "z", 9),  # the accent has no width
        ("\tlet z", "z", 8),  # a tab is four columns
        ("ab\tz", "z", 4),
    ],
)
def test_marks_are_below_the_marked_text(line: str, marked: str, before: int) -> None:
    source = Source("a.gb", line)
    rendered = render_text([Diagnostic("GB201", "m", span(source, marked))]).splitlines()
    excerpt, mark = rendered[3], rendered[4]
    assert mark == "  | " + " " * before + "^"
    assert display_width(excerpt[4 : excerpt.rindex(marked)], 0) == before


def test_a_long_line_is_cut_around_the_mark() -> None:
    source = Source("a.gb", "let a = " + " + ".join(f"x{i}" for i in range(2000)))
    rendered = render_text([Diagnostic("GB201", "m", span(source, "x1000"), "here")]).splitlines()
    assert len(rendered[3]) < 160
    assert rendered[3].index("x1000") == rendered[4].index("^^^^^")
    assert rendered[3].startswith("1 | …")
    assert rendered[3].endswith("…")


def test_a_place_at_the_end_of_the_text_has_a_mark() -> None:
    source = Source("a.gb", "let a =")
    rendered = render_text([Diagnostic("GB101", "m", Span(source, 7, 7), "here")]).splitlines()
    assert rendered[3:] == ["1 | let a =", "  |        ^ here"]


def test_a_place_over_several_lines_is_marked_on_its_first() -> None:
    source = Source("a.gb", "unknown f(x)\n    >= 0\n")
    rendered = render_text([Diagnostic("GB201", "m", Span(source, 8, 20))]).splitlines()
    assert rendered[3:] == ["1 | unknown f(x)", "  |         ^^^^"]


@pytest.mark.parametrize(
    ("cell", "place"),
    [
        (Cell("data.csv", 12, "x2"), ' --> data.csv: row 12, column "x2"'),
        (Cell("data.csv", 3), " --> data.csv: row 3"),
        (Cell("data.csv", column="x2"), ' --> data.csv: column "x2"'),
        (Cell("data.csv"), " --> data.csv"),
    ],
)
def test_a_place_in_a_table(cell: Cell, place: str) -> None:
    text = render_text([Diagnostic("GB701", "m", cell, help="h")])
    assert text == f"error[GB701]: m\n{place}\n  = help: h\n"


def test_a_diagnostic_without_a_place() -> None:
    assert render_text([Diagnostic("GB801", "m", None, help="h")]) == "error[GB801]: m\n  = help: h\n"


def test_nothing_in_a_file_reaches_the_terminal_as_a_command() -> None:
    source = Source("a\x1b[2J.gb", "let a = \x1b[31m3\u202e")
    text = render_text([Diagnostic("GB004", "bad \x1b]0;x\x07", Span(source, 8, 9))])
    assert not set("\x1b\x07\u202e") & set(text)
    assert printable("plain μ 生") == "plain μ 生"


def test_json_has_every_key_and_counts_from_one() -> None:
    data = to_json(example())
    assert list(data) == [
        *("code", "severity", "message", "file", "line", "column", "end_line", "end_column"),
        *("labels", "notes", "help"),
    ]
    assert (data["line"], data["column"], data["end_line"], data["end_column"]) == (10, 6, 10, 13)
    assert data["severity"] == "warning"
    first = {"file": "models/fermenter.gb", "line": 8, "column": 7, "end_line": 8, "end_column": 8}
    assert data["labels"][0] == first | {"text": "learnable constant"}
    json.dumps(data)


def test_json_of_a_cell() -> None:
    data = to_json(Diagnostic("GB701", "m", Cell("data.csv", 12, "x2")))
    assert (data["file"], data["line"], data["column"]) == ("data.csv", 12, None)
    assert data["cell"] == {"row": 12, "column": "x2"}
    assert to_json(Diagnostic("GB801", "m", None))["file"] is None


def test_diagnostics_come_in_the_order_of_the_text_and_once() -> None:
    findings = Findings()
    for text in ("mu", "k", "mu"):
        findings.error("GB201", f"`{text}`", span(FERMENTER, text))
    assert [finding.message for finding in findings] == ["`k`", "`mu`"]
    findings.warning("GB403", "w", span(FERMENTER, "D*X"))
    assert summary(findings) == "2 errors, 1 warning"
    assert summary([]) == ""
