"""Likely mistakes in a whole model, through every check: each gives one diagnostic, at its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import Findings, Source, Span
from gbspec.lower import lower
from gbspec.semantics import check
from gbspec.semantics.vocabulary import FUNCTIONS, suggestion
from gbspec.syntax.parser import parse

RIGHT = """model reactor "A reactor"
time t : h
unit gX
state X : gX/L in [0, 50] = 0.1 "biomass"
state S : g/L in [0, 20] = 10
condition D : 1/h in [0.1, 0.5]
const Sf : g/L = 10
learn Y : gX/g = 0.5 in [0.1, 1]
unknown mu(S) : 1/h >= 0 by mlp(8, 8)
process growth: 1/Y*S -> X rate mu(S)*X
X' = net(X) - D*X
S' = net(S) + D*(Sf - S)
observe X
observe S noise normal(0.1)
"""

SLIPS = [line.split("\t") for line in (Path(__file__).parent / "slips.tsv").read_text("utf-8").splitlines()[1:]]


def findings_of(text: str) -> Findings:
    findings = Findings()
    file = parse(Source("reactor.gb", text), findings)
    if file is not None and not findings.failed:
        checked = check(file, findings, lambda path: Source(str(path), ""))
        if checked is not None and not findings.failed:
            lower(checked, findings)
    return findings


def test_the_right_model_is_right() -> None:
    assert not list(findings_of(RIGHT))


def test_there_are_at_least_sixty_mistakes() -> None:
    assert len(SLIPS) >= 60
    assert len({slip for *_, slip in SLIPS}) == len(SLIPS)


@pytest.mark.parametrize(("code", "line", "marked", "right", "slip"), SLIPS, ids=[slip for *_, slip in SLIPS])
def test_a_mistake_is_one_diagnostic_at_its_place(code: str, line: str, marked: str, right: str, slip: str) -> None:
    assert right in RIGHT
    (finding,) = findings_of(RIGHT.replace(right, slip.replace("<tab>", "\t"), 1))
    assert isinstance(finding.place, Span)
    assert (finding.code, finding.place.position[0], finding.place.text) == (
        code,
        int(line),
        marked.replace("<tab>", "\t"),
    )
    assert finding.help or finding.label


@pytest.mark.parametrize(("name", "meant"), [("tahn", "tanh"), ("epx", "exp")])
def test_neighbouring_characters_exchanged_are_a_single_slip(name: str, meant: str) -> None:
    assert suggestion(name, FUNCTIONS) == f"did you mean `{meant}`?"
