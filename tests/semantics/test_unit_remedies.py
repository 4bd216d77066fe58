"""What is advised where units disagree is written into the text, which is then right."""

from __future__ import annotations

import re

import pytest

from gbspec.diagnostics import Diagnostic, Span
from tests.texts import checked

MODEL = """model remedies
time t : min
unit gX
state T : K in [250, 400] = 300
state x : g/L in [0, 9] = 1
state q : 1 in [0, 9] = 1
algebraic y : g/L in [0, 9] = 1
input hot : degC held
input flow : L/h held
input power : kW held
condition m0 : mg/L
const V : L = 2
const Ea : kJ/mol = 50
const R : J/mol/K = 8.314
const c : kJ/K = 4
const per_min : 1/min = 0.1
const share : percent = 20
const A : 1/h = 2
{declared}
equation level: {level}
T' = {heat}
x' = {mass}
q' = {pure}
initial x = {start}
observe T
observe x
{last}
"""
RIGHT = {
    "declared": "let z = 1",
    "level": "y = x",
    "heat": "per_min*((300 in K) - T)",
    "mass": "-per_min*x",
    "pure": "-per_min*q",
    "start": "1",
    "last": "observe q",
}
CASES = [
    # sums, comparisons and calls (GB502)
    ("heat", "per_min*((50 in degC) - T)"),
    ("heat", "per_min*(T - (50 in degC))"),
    ("heat", "per_min*(T - hot)"),
    ("heat", "per_min*(max(T, hot) - T)"),
    ("heat", "if(T > (50 in degC), 0, per_min*T)"),
    ("heat", "if(T > hot, 0, per_min*T)"),
    ("heat", "if(T > (300 in degF), 0, per_min*T)"),
    ("mass", "-per_min*(x + m0)"),
    ("mass", "-per_min*(x - (m0 + (3 in mg/L)))"),
    ("mass", "-per_min*(x + (m0 in kg/L))"),
    ("mass", "-per_min*x - flow/V*x"),
    ("mass", "-per_min*x - (flow/V  # dilution\n  *x)"),
    ("mass", "-per_min*x - x*A"),
    # pure numbers (GB503)
    ("pure", "per_min*exp(-Ea/(R*T))"),
    ("pure", "per_min*q^(share)"),
    ("pure", "per_min*exp(-(Ea/(R*T)))"),
    ("pure", "per_min*sin(A*t)"),
    ("pure", "per_min*exp(share)*q"),
    # declared units (GB504)
    ("heat", "power/c"),
    ("heat", "(power/c in K/h)"),
    ("mass", "-A*x"),
    ("mass", "A*x in g/L/s"),
    ("start", "m0"),
    ("start", "(m0 in kg/L)"),
    ("level", "y = m0"),
    ("declared", "let z : g/L = m0*1"),
    ("declared", "let z : K = hot"),
    ("declared", "function twice(a) = a + x\nlet z = twice(m0)"),
    ("declared", "let z : K = (50 in degC)"),
    ("declared", "unknown f(a : K) : 1/h\nlet z = f(50 in degC)"),
    ("declared", "unknown f(a : K) : 1/h\nlet z = f(hot)"),
    ("last", "observe z2 = x : mg/L"),
    ("last", "event heater when q > 2: x = m0"),
    ("last", "event heater when q > 2: T = hot"),
    ("last", "diffusion x = m0*sqrt(per_min)"),
]
SPLIT = re.compile(r"`(\(.*? in [^`]*\))`")


def mended(text: str, error: Diagnostic) -> str:
    """The text with what the help proposes in place of what is wrong; a constant that converts is a factor of it."""
    assert isinstance(error.place, Span)
    start, end = error.place.start, error.place.end
    named = re.search(r"multiply `.*` by a constant that converts: `(const per : .*)`", error.help)
    if named:
        return f"{text[:start]}({text[start:end]})*per{text[end:]}{named[1]}\n"
    found = SPLIT.search(error.help)
    assert found, error.help
    return text[:start] + found[1] + text[end:]


@pytest.mark.parametrize(("place", "written"), CASES)
def test_what_is_proposed_can_be_written_and_is_right(place: str, written: str) -> None:
    text = MODEL.format(**{**RIGHT, place: written})
    result, findings = checked(text)
    errors = [one for one in findings.errors if one.code in ("GB502", "GB503", "GB504")]
    assert result is None and len(errors) == len(findings.errors) == 1, [one.message for one in findings.errors]
    result, findings = checked(mended(text, errors[0]))
    assert result is not None, (errors[0].help, [(one.code, one.message) for one in findings.errors])


def test_a_statement_that_is_proposed_can_stand_in_the_place_of_the_wrong_one() -> None:
    text = MODEL.format(**RIGHT).replace("observe x\n", "observe x : mg/L\n")
    (error,) = checked(text)[1].errors
    found = re.search(r"`(observe .*)`", error.help)
    assert found is not None, error.help
    assert checked(text.replace("observe x : mg/L", found[1]))[0] is not None


@pytest.mark.parametrize("written", ["exp(-(300 in K)/hot)", "exp(-Ea/((8.314 in kJ/mol/K)*hot))", "exp(-hot/T)"])
def test_a_temperature_that_must_be_absolute_is_converted(written: str) -> None:
    (error,) = checked(MODEL.format(**{**RIGHT, "pure": f"per_min*{written}*q"}))[1].errors
    assert error.code == "GB503" and "`(hot in K)`" in error.help
    assert (
        checked(MODEL.format(**{**RIGHT, "pure": f"per_min*{written.replace('hot', '(hot in K)')}*q"}))[0] is not None
    )


def test_a_comment_is_no_part_of_what_is_told() -> None:
    (error,) = checked(MODEL.format(**{**RIGHT, "mass": "-per_min*(x - (m0 # a dose\n  + m0))"}))[1].errors
    assert "`m0 + m0`" in error.message and "dose" not in error.message + error.help


def test_the_model_itself_is_right() -> None:
    assert checked(MODEL.format(**RIGHT))[0] is not None
