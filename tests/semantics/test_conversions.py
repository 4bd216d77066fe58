"""Quantities that are given in a unit are what they would be if they were written in the declared one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.ir import METHODS, Model
from tests.texts import codes, model_of

HEAD = """model m
time t : min
state T : degC in [0, 90] = 20
state q : A*h in [0, 3] = 1
condition I : A in [0, 5] = 2
const R : mohm = 25
const Ta : degC = 15
const L : H = {number}
learn h : W/K = 1
learn C : J/K = 2
"""


def of(number: str = "3.2 in mH", balance: str = "-I in A*h/min", warming: str = "0", channel: str = "q") -> Model:
    text = HEAD.format(number=number)
    return model_of(f"{text}q' = {balance}\nT' = {warming}\nobserve y = {channel}\nobserve T\n")


def rates(model: Model, temperature: float = 40.0, charge: float = 1.5) -> tuple[float, float, float]:
    """The rates of T and q, and the channel y."""
    made = load_module(model, METHODS["rk4"]).random()
    x, condition = np.array([temperature, charge]), np.array([2.0])
    rate = made.rhs(0.0, x, condition)
    return float(rate[0]), float(rate[1]), float(made.observe(0.0, x, condition)[0])


@pytest.mark.parametrize(
    ("number", "value"),
    [
        ("3.2 in mH", 3.2e-3),
        ("(3.2 in mH)", 3.2e-3),
        ("-4 in uH", -4e-6),
        ("2 in H", 2.0),
        ("+7 in kH", 7e3),
        ("7", 7.0),
    ],
)
def test_a_number_is_in_the_unit_that_follows_it(number: str, value: float) -> None:
    (found,) = (c.value for c in of(number).constants if c.name == "L")
    assert float(found) == pytest.approx(value, rel=1e-15)


def test_the_value_of_an_expression_is_converted() -> None:
    assert rates(of(balance="-I in A*h/min"))[1] == pytest.approx(-2 / 60, rel=1e-15)
    assert rates(of(channel="(I*R in V)"))[2] == pytest.approx(0.05, rel=1e-15)
    assert rates(of(channel="exp(I*R/(1000 in mV))"))[2] == pytest.approx(math.exp(0.05), rel=1e-15)
    assert rates(of(channel="q in mA*h"))[2] == pytest.approx(1500, rel=1e-15)
    assert rates(of(channel="max(q in C, 3 in C)"))[2] == pytest.approx(5400, rel=1e-15)
    assert rates(of(channel="((q in mA*h) in kA*h)"))[2] == pytest.approx(1.5e-3, rel=1e-15)


def test_temperatures_convert_with_their_zero_and_differences_without() -> None:
    assert rates(of(channel="T in K"))[2] == pytest.approx(313.15)
    assert rates(of(channel="T in degF"))[2] == pytest.approx(104)
    assert rates(of(channel="(T - Ta in K)"))[2] == pytest.approx(25)
    assert rates(of(channel="(T - Ta in delta_degF)"))[2] == pytest.approx(45)
    assert rates(of(warming="h*(Ta - T)/C in K/min"))[0] == pytest.approx(-60 * 25 / 2)
    assert rates(of(warming="h*(Ta - (T + T)/2)/C in K/min"))[0] == pytest.approx(-60 * 25 / 2)


@pytest.mark.parametrize("channel", ["T - (5 in delta_degC)", "Ta - T + (3 in K)", "T - Ta + T"])
def test_differences_of_temperatures_agree_with_kelvins_and_add_to_temperatures(channel: str) -> None:
    assert rates(of(channel=f"({channel} in K)"))[2] is not None


@pytest.mark.parametrize(
    "line",
    [
        "let a = T + (3 in K) - (300 in K)*2\nlet b = a*T",
        "let a = exp(-(3 in J)/((8 in J/K)*T))",  # a temperature is no difference
        "let a : K = T",
        "let a = (T in A)",
        "let a = if((3 in K) > (2 in s), T, Ta)",
    ],
)
def test_what_does_not_agree(line: str) -> None:
    found = codes(HEAD.format(number=1) + f"{line}\nq' = -I in A*h/min\nT' = 0\nobserve q\nobserve T\nallow GB403\n")
    assert {code for code in found if code.startswith(("GB5", "GB7"))}


def test_starts_times_and_ranges_of_other_statements() -> None:
    model = model_of(
        "model m\ntime t : h from 30 in min\nstate x : m = 20 in cm\nlearn k : 1/h = 2 in 1/d in [0.01, 1]\n"
        "dose x over 30 in min\ncondition c : m in [0, 1] = 5 in mm\nevent e at 90 in min every 1 in day: x = 3 in mm\n"
        "x' = -k*x\ninitial x = 30 in mm\nobserve x\ntruth k = 1.2 in 1/d\nallow GB403\n"
    )
    assert model.time.start is not None and float(model.time.start) == 0.5
    assert model.learnables[0].start == pytest.approx(2 / 24)
    assert float(model.truth_constants[0].value) == pytest.approx(0.05)
    assert float(model.states[0].initial.value) == pytest.approx(0.03)
    assert float(model.conditions[0].default) == pytest.approx(0.005)


def test_arrays_are_converted_like_others() -> None:
    model = model_of(
        "model m\ntime t : min\nconst N = 3\nstate c[1..N] : mol = 1\nlearn k[1..N] : 1/h = 1\n"
        "c[i]' = -k[i]*c[i] in mol/min\nobserve s = sum(c) in mmol\n"
    )
    made = load_module(model, METHODS["rk4"]).random()
    assert np.allclose(made.rhs(0.0, np.array([1.0, 2.0, 3.0])), -np.array([1, 2, 3]) / 60, rtol=1e-15)
    assert float(made.observe(0.0, np.array([1.0, 2.0, 3.0]))[0]) == pytest.approx(6000)


def test_in_before_a_bracket_is_a_range_and_a_name_may_be_called_in() -> None:
    model = model_of(
        "model m\ntime t : s\nstate x : m = 3 in mm in [0, 2]\nconst in : 1/s = 2 in 1/min\nx' = -in*x\nobserve x\n"
    )
    assert model.states[0].range is not None and model.states[0].range.high == 2
    assert float(model.constants[0].value) == pytest.approx(1 / 30)


def test_percent_may_be_written_as_its_sign() -> None:
    text = """model m
time t : s
state soc : % in [0, 100] = 50
const k : %/s = 10
const half : 1 = 50 in %
soc' = -k*half
observe soc noise normal(0.02 in 1)
"""
    for made in (model_of(text), model_of(text.replace("%", "percent"))):
        assert str(made.states[0].unit) == "percent"
        assert float(next(c.value for c in made.constants if c.name == "half")) == 0.5
        assert str(made.channels[0].noise) == str(model_of(text.replace("0.02 in 1", "2")).channels[0].noise)


def test_the_number_of_a_noise_may_be_given_in_a_unit() -> None:
    text = "model m\ntime t : s\nstate x : m = 1\nx' = -x*(1 in 1/s)\nobserve x noise normal({})\n"
    for given in ("3 in cm", "(3 in cm)"):
        assert model_of(text.format(given)).channels[0].noise == model_of(text.format("0.03")).channels[0].noise
