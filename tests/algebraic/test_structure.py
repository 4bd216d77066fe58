"""Which equations determine which variables, formulas, failures that are named, and what the language makes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sympy
import torch
from sympy.core.function import AppliedUndef

from gbspec.backends import Evaluator
from gbspec.backends.latex import document
from gbspec.backends.module import load_module
from gbspec.diagnostics import ComputationError, Findings, Source
from gbspec.frontend import load_model
from gbspec.ir import STIFF, symbol
from gbspec.ir.dumping import dump
from gbspec.passes.linear import MOST_OPERATIONS, MOST_VARIABLES, solved_by_formulas
from gbspec.report.text import model_summary
from gbspec.syntax.formatter import format_text
from tests.algebraic.models import ARRAY, BUFFER, TWO_ROOTS, UNKNOWN, built


def test_blocks_come_in_the_order_of_their_solution() -> None:
    model = built(UNKNOWN)
    assert [(b.equations, b.variables, b.explicit) for b in model.blocks] == [
        (("one", "two"), ("y", "z"), False),
        (("three",), ("r",), True),
    ]
    assert [item.name for item in model.algebraics] == ["y", "z"]
    assert model.intermediates[0].name == "r"
    rows = built(ARRAY)
    assert [b.variables for b in rows.blocks] == [("q_1",), ("q_2",), ("q_3",), ("p",)]
    assert "one, two for y, z" in dump(model)
    assert "algebraic y in [-5, 5], z in [-5, 5] by one, two, 2 equations together" in model_summary(model)
    assert "algebraic r by three, a formula" in model_summary(model)


def test_only_formulas_leave_an_ordinary_model() -> None:
    text = BUFFER.replace("charge: b + 10^(-pH) = 10^(pH - 14) + a/(1 + 10^(pKa - pH))", "charge: 2*pH - pKa = a + b")
    model = built(text)
    assert not model.algebraics
    assert str(model.intermediates[0].value) == "a/2 + b/2 + pKa/2"


def test_the_start_chooses_among_solutions() -> None:
    model = built(TWO_ROOTS.replace("in [0, 10] = 3", "in [-10, 10] = 3"))
    other = built(TWO_ROOTS.replace("in [0, 10] = 3", "in [-10, 10] = -3"))
    for made, root in ((model, 2.0), (other, -2.0)):
        member = load_module(made)()
        assert member.observe(0.0, [4.0]).tolist() == [4.0, root]
        assert np.array(member.casadi_observe()(0, [4.0], [], [])).ravel().tolist() == [4.0, root]


@pytest.mark.parametrize("state", [0.0, -1.0])
def test_where_there_is_no_solution_values_are_not_numbers(state: float) -> None:
    member = load_module(built(TWO_ROOTS.replace("y^2", "y^2 + 1")))()
    assert torch.isnan(member.rhs(0.0, [state])).all()
    assert np.isnan(np.array(member.casadi_rhs()(0, [state], [], []))).all()
    given = (0.0, np.array([state]), np.zeros(0), np.zeros(0), (), ())
    text = member.equations.unsolved(member.arithmetic("numpy"), *given)
    assert text.startswith("no solution of the equation `square` (residual ")
    assert "`y` = " in text


def test_a_solution_that_ends_names_the_equation() -> None:
    member = load_module(built(TWO_ROOTS.replace("1 - y", "-1 - y")))()
    with pytest.raises(ComputationError, match="equation `square`"):
        Evaluator(member).integrate([1.0], [0.0, 0.2, 4.0])


def test_solutions_start_consistent_and_follow_the_equation() -> None:
    member = load_module(built(TWO_ROOTS))()
    found = Evaluator(member).integrate([0.25], [0.0, 1.0, 3.0])[:, 0]
    steps = member.simulate([0.25], [0.0, 1.0, 3.0], max_step=0.01)[:, 0].numpy()
    y = np.sqrt(found)  # which solves y + log(1 - y) = -t/2 + c
    assert y + np.log(1 - y) == pytest.approx(0.5 + np.log(0.5) - np.array([0.0, 1.0, 3.0]) / 2, abs=1e-8)
    assert steps == pytest.approx(found, abs=1e-8)


def test_an_equation_is_replaced_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "base.gb").write_text(TWO_ROOTS)
    (tmp_path / "child.gb").write_text('model child extends "base.gb"\nequation square: y^3 = x\n')
    model = load_model(tmp_path / "child.gb", Findings())
    assert [str(e.left) for e in model.constraints] == ["y**3"]
    (tmp_path / "gone.gb").write_text(
        'model gone extends "base.gb"\nwithout square\nwithout y\nlet y = 2*x\nx\' = 1 - y\nobserve y\n'
    )
    assert not load_model(tmp_path / "gone.gb", Findings()).constraints


def test_the_formatter_keeps_statements() -> None:
    text = 'algebraic   q[1..3] =1 in [ 0,10 ] :m\nequation  flow [i] :  q[i]^3+q[i]=c[i]  "text"\n'
    once = format_text(Source("a.gb", text))
    assert once == 'algebraic q[1..3] : m in [0, 10] = 1\nequation flow[i]: q[i]^3 + q[i] = c[i] "text"\n'
    assert format_text(Source("a.gb", once)) == once


def test_words_are_names_elsewhere() -> None:
    model = built(
        "model words\nstate algebraic = 1\nstate equation = 1\nalgebraic' = -equation\nequation' = -algebraic\n"
    )
    assert [s.name for s in model.states] == ["algebraic", "equation"]


def test_equations_are_typeset() -> None:
    text = document(built(BUFFER))
    assert "Algebraic equations" in text
    assert "10^{- \\mathrm{pH}}" in text


def test_claims_about_algebraic_variables_are_undecided() -> None:
    findings = Findings()
    from gbspec.passes.claims import check_claims

    check_claims(built(TWO_ROOTS + "conserve square_of_x = y\n"), findings)
    assert [d.code for d in findings] == ["GB331"]


def test_stiff_steps_solve_for_algebraic_variables_too() -> None:
    model = built(TWO_ROOTS.replace("1 - y", "50*(1 - y)"))
    member = load_module(model, STIFF)()
    found = member.simulate([0.25], [0.0, 0.05, 0.1, 1.0], max_step=0.002)[:, 0].numpy()
    expected = Evaluator(load_module(model)()).integrate([0.25], [0.0, 0.05, 0.1, 1.0])[:, 0]
    assert found == pytest.approx(expected, rel=1e-5)


def test_linear_blocks_beyond_either_limit_are_searched() -> None:
    """Formulas of many variables grow like their factorial, and long ones are written once for each variable."""
    some = [symbol(f"v{i}") for i in range(MOST_VARIABLES + 1)]
    assert solved_by_formulas([v - 1 for v in some[1:]], some[1:]) == [sympy.S.One] * MOST_VARIABLES
    assert solved_by_formulas([v - 1 for v in some], some) == []
    long = sympy.Add(*(symbol(f"x{i}") ** 2 for i in range(MOST_OPERATIONS)))
    assert solved_by_formulas([some[0] - long], some[:1]) == []


def test_linear_blocks_are_solved_by_formulas() -> None:
    model = built(
        """model linear
state x in [0, 4] = 1
learn k = 2 in [1, 3]
unknown f(x) by mlp(3)
algebraic y
algebraic z
algebraic w
algebraic v = 0.3
x' = w - y
equation one: y*(1 + x) + k*z = 3 + f(x)
equation two: z - 0.5*y = x
equation three: k*w = y^2
equation four: v^3 + v = w
observe v
"""
    )
    assert [(b.variables, b.explicit) for b in model.blocks] == [(("y", "z"), True), (("w",), True), (("v",), False)]
    assert [item.name for item in model.algebraics] == ["v"]
    at = {symbol("x"): 0.7, symbol("k"): 1.9}
    y, z = (
        float(item.value.replace(lambda e: isinstance(e, AppliedUndef), lambda e: sympy.Float(0.4)).xreplace(at))
        for item in model.intermediates[:2]
    )
    assert y * 1.7 + 1.9 * z == pytest.approx(3.4)
    assert z - 0.5 * y == pytest.approx(0.7)


def test_a_formula_s_variable_is_a_threshold() -> None:
    """It changes continuously: its crossing is found, with `or` too, where it is no step between two numbers."""
    text = """model leaking
time t from 0
state x in [0, 5]
discrete n = 0
learn k = 0.7 in [0.1, 2]
algebraic y in [-5, 5] = 1
x' = 0.8 - 0.1*y
equation e: y*(1 + k) = x
event up when y >= 0.9: n = n + 1
event other when y >= 0.9 or x >= 4: n = n + 1
observe x
observe n
"""
    model = built(text)
    assert len(model.events) == 2
    assert not any(event.guard is not None and event.guard.has(sympy.Piecewise) for event in model.events)
