"""The canonical form, and that formatting changes neither meaning nor comments."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import example, given, settings

from gbspec.diagnostics import Findings, Source, UserError
from gbspec.syntax.formatter import WIDTH, format_text
from gbspec.syntax.parser import parse, read_source
from gbspec.syntax.walking import same
from tests.syntax.texts import files

ROOT = Path(__file__).parents[2]


def formatted(text: str) -> str:
    return format_text(Source("test.gb", text))


def comments(text: str) -> list[str]:
    return sorted(re.findall(r"#.*", re.sub(r'"[^"\n]*"', "", text)))


@settings(max_examples=150, deadline=None)
@given(files())
@example("process x : -> rate [ x ] rate x\n")
def test_meaning_and_comments_stay_and_a_second_time_changes_nothing(text: str) -> None:
    findings = Findings()
    before = parse(Source("test.gb", text), findings)
    assert not list(findings), text
    once = formatted(text)
    assert same(before, parse(Source("test.gb", once), Findings()))
    assert comments(once) == [comment.rstrip() for comment in comments(text)]
    assert formatted(once) == once


@pytest.mark.parametrize(
    ("written", "canonical"),
    [
        ("state   X:gX/L in[0,50]=0.1", "state X : gX/L in [0, 50] = 0.1"),
        ('state X "biomass" = 0.1 in [0, 50] : gX/L', 'state X : gX/L in [0, 50] = 0.1 "biomass"'),
        (
            "learn k > 0 per trajectory prior normal(3,.5) = 1 : 1/h",
            "learn k : 1/h = 1 > 0 prior normal(3, .5) per trajectory",
        ),
        ("X ' =net( X )-D * X", "X' = net(X) - D*X"),
        ("x' = -x**2 + 2^-1", "x' = -x^2 + 2^-1"),
        ("let a = - ( - b ) * - c", "let a = -(-b)*-c"),
        ("c [ i ] ' = (c[i - 1] -2* c[i]+c[i+1])/h^2", "c[i]' = (c[i-1] - 2*c[i] + c[i+1])/h^2"),
        ("state c [1 .. N]", "state c[1..N]"),
        ("state c[1. .. .5]", "state c[1. .. .5]"),
        ("process g :1/Y * S->X  rate mu(S)*X", "process g: 1/Y*S -> X rate mu(S)*X"),
        ("process out:X-> rate rate(X)", "process out: X -> rate rate(X)"),
        ("process q: -> X rate (k + 1)*X", "process q: -> X rate (k + 1)*X"),
        ("let a = if(x>3 and not(y<= -2 or z==3),1,-2)", "let a = if(x > 3 and not (y <= -2 or z == 3), 1, -2)"),
        ("unknown a,b(x,y:g in [0,1]):u1,u2", "unknown a, b(x, y : g in [0, 1]) : u1, u2"),
        (
            "unknown f(x) by mlp( 32,activation = silu ) >= 0 zero at x=0",
            "unknown f(x) >= 0, zero at x = 0 by mlp(32, activation=silu)",
        ),
        ('observe y as "OD 600" noise normal( 0.05 ) = 2*X', 'observe y = 2*X noise normal(0.05) as "OD 600"'),
        ("input F linear :L/h", "input F : L/h linear"),
        ("time t from -3 : h", "time t : h from -3"),
        ("dose S lag tlag times (F+1)", "dose S times (F + 1) lag tlag"),
        ("conserve m rate r = X+S", "conserve m = X + S rate r"),
        ('model m extends "a.gb" "title"', 'model m "title" extends "a.gb"'),
        ("state x : m*(s ^ -2)/(kg*K)", "state x : m*(s^-2)/(kg*K)"),
        ("const µ = 1", "const μ = 1"),
        ("let a = b#why", "let a = b  #why"),
        ("truth phi ( x ) = x", "truth phi(x) = x"),
        ("const L:H=3.2 in  mH", "const L : H = 3.2 in mH"),
        ("const k:%/s^2=1 in(%)", "const k : %/s^2 = 1 in (%)"),
        ("observe y:% noise normal(3 in%)", "observe y : % noise normal(3 in %)"),
        ("const L = 3.2 in(J /K) : H", "const L : H = 3.2 in (J/K)"),
        ("let P : W = (u*i in 1 / h)*in", "let P : W = (u*i in 1/h)*in"),
        ("learn k = 2 in 1/d in[0,1] : 1/h", "learn k : 1/h = 2 in 1/d in [0, 1]"),
        ("process p: -> rate[ 2 ] rate x", "process p: -> rate[2] rate x"),
        ("event e at 9 in h every 1 in day : x=3 in mm", "event e at 9 in h every 1 in day: x = 3 in mm"),
    ],
)
def test_one_statement(written: str, canonical: str) -> None:
    assert formatted(written) == canonical + "\n"


def test_empty_lines_and_comments_between_statements() -> None:
    text = "\n\n# head\n\n\n\nmodel m\nstate x  # x\n\n   # indented\n\n\n\nx' = 1\n\n"
    assert formatted(text) == "# head\n\nmodel m\nstate x  # x\n\n# indented\n\nx' = 1\n"


def test_empty_files() -> None:
    assert formatted("") == ""
    assert formatted("\n \n") == ""
    assert formatted("# only\n") == "# only\n"


def test_lines_that_begin_with_a_clause_stay_lines() -> None:
    text = "unknown mu(u, g) : 1/h\n  >= 0, zero at u = 0\n  = monod(u,K)*nn by mlp(32)\n"
    assert formatted(text) == (
        "unknown mu(u, g) : 1/h\n    >= 0, zero at u = 0\n    = monod(u, K)*nn\n    by mlp(32)\n"
    )


def test_comments_inside_a_statement_stay_where_they_are() -> None:
    text = "let r = a   # first\n\n  + b  # second\n    # own\n  - c # last\n"
    assert formatted(text) == "let r = a  # first\n    + b  # second\n    # own\n    - c  # last\n"
    clauses = "state X  # state\n  = 0.1 # start\n  : g/L # unit\n"
    assert formatted(clauses) == "state X  # state\n    = 0.1  # start\n    : g/L  # unit\n"


def test_long_statements_are_broken() -> None:
    terms = " + ".join(f"k_{i}*x_{i}*exp(-E_{i}/(R*T))" for i in range(30))
    lines = formatted(f"x' = {terms}").splitlines()
    assert len(lines) > 5
    assert all(len(line) <= WIDTH for line in lines)
    assert all(line.startswith("    + ") for line in lines[1:])
    clauses = formatted(f'learn {"a" * 60} : 1/h = 1 in [0, 10] prior normal(3, 0.5) "{"d" * 40}"').splitlines()
    assert [line.split()[0] for line in clauses] == ["learn", "=", "in", "prior", f'"{"d" * 40}"']


def test_a_sum_of_5000_terms_is_formatted() -> None:
    text = "let a=" + "+".join(f"x{i}" for i in range(5000))
    once = formatted(text)
    assert formatted(once) == once


def test_a_wrong_file_is_refused_with_every_diagnostic() -> None:
    with pytest.raises(UserError) as caught:
        formatted("let a = (b\nlet c = 2d\n")
    assert [finding.code for finding in caught.value.diagnostics] == ["GB105", "GB116"]


@pytest.mark.parametrize("path", sorted(ROOT.glob("models/**/*.gb")), ids=lambda path: path.stem)
def test_bundled_models_keep_their_meaning(path: Path) -> None:
    source = read_source(path)
    once = format_text(source)
    assert format_text(Source(source.path, once)) == once
    assert same(parse(source, Findings()), parse(Source(source.path, once), Findings()))


def test_contracts_after_a_comment_are_indented_like_the_first() -> None:
    text = "model m\nstate x\nunknown f(x)\n    >= 0,  # a rate\n    zero at x = 0\n    by mlp(8)\nx' = f\n"
    assert format_text(Source("m.gb", text)) == text
