"""Models with algebraic variables, as texts."""

from __future__ import annotations

from gbspec.diagnostics import Findings
from gbspec.ir.model import Model
from gbspec.passes.structure import with_structure
from tests.training.conftest import model_of

BUFFER = """model buffer
state a in [0, 0.1]
state b in [0, 0.1]
learn pKa = 4.5 in [3, 6]
learn k = 0.2 in [0, 1]
learn c = 0.02 in [0.001, 0.1]
algebraic pH in [0, 14] = 7
a' = 0.5*(c - a) - k*a*pH/7
b' = 0.5*(0.01 - b)
equation charge: b + 10^(-pH) = 10^(pH - 14) + a/(1 + 10^(pKa - pH))
observe pH
observe a
truth pKa = 4.75
truth k = 0.3
truth c = 0.03
"""

UNKNOWN = """model unknown_inside
time t from 0
state x in [0, 2]
input u linear
learn s = 1.1 in [0.5, 2]
learn own = 0.4 > 0 per trajectory
unknown f(y) by mlp(4, activation=tanh)
unknown g(x) by mlp(3, activation=tanh)
algebraic y in [-5, 5]
algebraic z in [-5, 5] = 0.5
algebraic r
x' = -own*x + 0.3*f + 0.2*z + 0.1*u + 0.1*g + 0.1*r
equation one: y + 0.2*f(y) = x + 0.1*z*z + 0.1*g
equation two: 0 = z + z^3/3 - s*y + 0.1*t
equation three: r = x*y
dose x
observe x
observe total = x + y*z
"""

ARRAY = """model rows
state c[1..3] in [0, 4] = 1
algebraic q[1..3] in [0, 10] = 1
algebraic p in [0, 10] = 1
learn k = 1 in [0.1, 3]
c[i]' = -q[i] + 0.1*p
equation flow[i]: q[i]^3 + k*q[i] = c[i]
equation all: p^2 + p = sum(c) + q[1]
observe c
observe q
"""

TWO_ROOTS = """model two_roots
state x in [0, 4] = 1
algebraic y in [0, 10] = 3
x' = 1 - y
equation square: y^2 = x
observe x
observe y
"""


def built(text: str) -> Model:
    """The Model of a text, with its equations in blocks."""
    findings = Findings()
    model = with_structure(model_of(text), findings)
    findings.raise_if_failed()
    return model
