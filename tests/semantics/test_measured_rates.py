"""`observe r = X'`: the right side of the balance in place of the rate."""

from __future__ import annotations

import sympy

from tests.texts import codes, model_of

CULTURE = """model culture
state X
state S
learn Y = 0.5
unknown mu(S)
let growth = mu*X
process grow: 1/Y*S -> X rate growth
S' = net(S) - 0.1*S
observe X
observe uptake = -S'
observe double = (X' - 1)*2
"""
ROW = """model row
state c[1..3]
learn D = 1
c[i]' = D*(c[i-1] - c[i])
c[0] = 2
observe r = c[2]' + c[1]'
"""


def test_a_rate_is_the_balance() -> None:
    model = model_of(CULTURE)
    rates = dict(zip((s.name for s in model.states), model.balances, strict=True))
    _, uptake, double = model.channels
    assert uptake.value == -rates["S"]
    assert sympy.expand(double.value - 2 * (rates["X"] - 1)) == 0
    assert uptake.state is None, "a rate resets no state"


def test_a_rate_of_an_element() -> None:
    model = model_of(ROW)
    c1, c2, d = (sympy.Symbol(name, real=True) for name in ("c_1", "c_2", "D"))
    assert sympy.expand(model.channels[0].value - (d * (c1 - c2) + d * (2 - c1))) == 0


def test_units_of_a_rate_are_checked() -> None:
    text = "model m\ntime t : h\nstate x : g\nx' = -2*x\nobserve r : {} = x'\n"
    assert "GB5" not in "".join(codes(text.format("g/h").replace("-2*x", "-k*x") + "learn k : 1/h = 2\n"))
    wrong = codes(text.format("g").replace("-2*x", "-k*x") + "learn k : 1/h = 2\n")
    assert [code[:3] for code in wrong] == ["GB5"]


def test_rates_stand_only_in_channels() -> None:
    assert codes("model m\nstate x\nlet z = x'\nx' = -z\nobserve x\n") == ["GB139"]
    assert codes("model m\nstate x\nstate y\nx' = -x\ny' = x'\nobserve x\nobserve y\n") == ["GB139"]
    assert codes("model m\nstate x\nlearn k = 1\nx' = -k*x\nobserve x\nobserve r = k'\n") == ["GB139"]


def test_a_mistake_in_a_balance_is_told_once() -> None:
    assert codes("model m\nstate x\nx' = -sin(x, 2)\nobserve x\nobserve r = x'\n") == ["GB207"]
