"""What can be told apart does not depend on the units in which states and constants are written."""

from __future__ import annotations

import re

import pytest

from gbspec.diagnostics import Findings
from gbspec.passes.identifiability import identifiability
from gbspec.passes.identifiability.directions import Directions, find
from gbspec.passes.identifiability.question import pose
from gbspec.passes.identifiability.series import Effort
from gbspec.passes.identifiability.undecided import Open, Why
from tests.texts import model_of

EPIDEMIC = """model epidemic
time t from 0
{population}
state S in [0, {n}]
state I in [0, {n}]
learn b = 0.15 in [0.02, 10]
learn g = 0.1 in [0.02, 1]
learn rho = 0.05 in [0.0001, 1]
learn I0 = 10 in [0.1, 50]
S' = -b*S*I/N
I' = b*S*I/N - g*I
initial S = N - I0
initial I = I0
observe cases = rho*b*S*I/N
"""

VIRUS = """model virus
time t from 0
state T in [0, 1e9]
state I in [0, 1e9]
state V in [0, 1e12]
{cells}
learn beta = {beta} in [{beta}/100, {beta}*100]
learn delta = 1 in [0.01, 10]
learn p = 1e-3 in [1e-6, 1]
learn c = 10 in [0.1, 100]
learn V0 = 1e-3 in [1e-6, 1]
T' = -beta*T*V
I' = beta*T*V - delta*I
V' = p*I - c*V
initial T = T0
initial I = 0
initial V = V0
observe {seen}
"""

BINDING = """model binding
time t from 0
const A0 = {size}
const B0 = 2*{size}
state C in [0, {size}]
learn kon = {on} in [{on}/100, {on}*100]
learn koff = 1e-3 in [1e-6, 1]
learn scale = 1e3 in [1, 1e6]
C' = kon*(A0 - C)*(B0 - C) - koff*C
initial C = 0
observe y = scale*C{gain}
"""


def sets(text: str) -> tuple[bool, list[set[str]]]:
    found = identifiability(model_of(text), Findings())
    return found.decided, [set(each.names) for each in found.sets]


@pytest.mark.parametrize("n", ["1e3", "102225", "1e5", "1e7"])
def test_a_known_population_of_any_size_tells_all_constants_of_an_epidemic_apart(n: str) -> None:
    assert sets(EPIDEMIC.format(population=f"const N = {n}", n=n)) == (True, [])


def copies(n: str, count: int) -> str:
    """Epidemics that do not affect each other, as one model."""
    head, body = EPIDEMIC.format(population=f"const N = {n}", n=n).split("\nstate S", 1)
    body = re.sub(r"\bI0\b", "J", f"state S{body}")
    parts = [re.sub(r"\b(S|I|b|g|rho|J|cases)\b", rf"\g<1>{j}", body) for j in range(count)]
    return head + "\n" + "".join(parts)


@pytest.mark.parametrize("n", ["1e5", "1e6"])
def test_several_epidemics_are_examined_with_many_digits_too(n: str) -> None:
    assert sets(copies(n, 3)) == (True, [])


@pytest.mark.parametrize("budget", [3e6, 6e6, 8e6, 9e6, 1.1e7, 2e7])
def test_what_may_be_rounding_is_not_an_answer(budget: float) -> None:
    """Where the effort ends before numbers of many digits have decided, the question is open."""
    found = identifiability(model_of(EPIDEMIC.format(population="const N = 1e5", n="1e5")), Findings(), budget)
    assert found.sets == () and found.decided is (found.reason == "")


def test_an_open_question_says_that_what_is_left_may_be_rounding() -> None:
    question = pose(model_of(EPIDEMIC.format(population="const N = 1e5", n="1e5")), all_states=False)
    budgets = [k * 1e6 for k in range(2, 16, 2)]
    found = [find(question, Effort(budget)) for budget in budgets]
    left = [each.why if isinstance(each, Open) else each.basis.shape[1] for each in found]
    assert set(left) == {Why.EFFORT, Why.ROUNDING, 0}
    assert isinstance(found[-1], Directions) and isinstance(find(question, Effort()), Directions)


@pytest.mark.parametrize("n", ["1e3", "1e5", "1e7"])
def test_a_learned_population_of_any_size_is_not_told_from_the_reported_share(n: str) -> None:
    text = EPIDEMIC.format(population=f"learn N = {n} in [{n}/10, {n}*10]", n=f"{n}*10")
    assert sets(text) == (True, [{"N", "rho", "I0"}])
    # Reported in two parts, of which only the sum is seen: no scaling, and as little to be told apart.
    text = EPIDEMIC.format(population=f"const N = {n}", n=n)
    text = text.replace("cases = rho*b", "cases = (rho + 0.5*q + 3*q*rho)*b").replace(
        "learn I0", "learn q = 0.1\nlearn I0"
    )
    assert sets(text) == (True, [{"rho", "q"}])


@pytest.mark.parametrize("cells", [1.0, 1e8])
def test_cells_of_any_number_and_rates_of_any_size(cells: float) -> None:
    known = VIRUS.format(cells=f"const T0 = {cells}", beta=1 / cells, seen="V")
    assert sets(known) == (True, [])
    free = VIRUS.format(cells=f"learn T0 = {cells} in [{cells}/10, {cells}*10]", beta=1 / cells, seen="V")
    assert sets(free) == (True, [{"p", "T0"}])
    unscaled = known.replace("observe V", "learn s = 1e-4 in [1e-8, 1]\nobserve y = s*V")
    assert sets(unscaled) == (True, [{"beta", "p", "V0", "s"}])


@pytest.mark.parametrize("size", [1.0, 1e-9])
def test_concentrations_of_any_unit(size: float) -> None:
    text = BINDING.format(size=size, on=1e-3 / size, gain="")
    assert sets(text) == (True, [])
    assert sets(BINDING.format(size=size, on=1e-3 / size, gain="*(koff + gain)\nlearn gain = 1")) == (
        True,
        [{"scale", "gain"}],
    )
