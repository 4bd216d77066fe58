"""Expressions as the language writes them."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings
from gbspec.ir import in_language
from gbspec.passes import examine
from gbspec.report import model_summary
from tests.texts import model_of

MODEL = (
    'model m\ncondition v in {{"wild type", F}}\ncondition u in [0, 9]\nlearn D = 2 in [1, 9]\n'
    "state x in [0, 9]\ninitial x = {}\nx' = -x\nobserve x\nallow GB403\n"
)


@pytest.mark.parametrize(
    "text",
    [
        "if(v == F, D, 1)",
        'if(v == "wild type", D, 1)',
        "D*if(v == F, 2, 1)",
        "if(v == F, D, if(u <= 3, 2*D, 1))",
        "if(not (v == F), D, 1)",
        "if(u == 3, D, 1)",
        "if((v == F) and (u > 2), D, 1)",
        "if((u > 2) or (u < 1), D, 1)",
        "D^2",
        "sqrt(D)",
        "exp(1)*D",
        "max(1, D)",
        "abs(D - u)",
    ],
)
def test_an_expression_is_written_as_it_is_read(text: str) -> None:
    model = model_of(MODEL.format(text))
    (state,) = model.states
    assert state.initial.value is not None
    assert in_language(state.initial.value, model.conditions) == text
    assert f"= {text} " in model_summary(model)


def test_a_conserved_quantity_names_categories() -> None:
    model = model_of(
        "model m\ncondition v in {F, P}\nstate X\nstate S\nlearn Y = 1\nX' = S\nS' = -S/if(v == F, Y, 2)\n"
        "observe X\nobserve S\n"
    )
    (law,) = examine(model, Findings()).laws
    assert "if(v == F, " in str(law)


def test_columns_that_group_trajectories_are_no_conditions() -> None:
    model = model_of(
        "model m\ncondition u in [0, 9]\nstate x\nlearn k = 1 in [0, 9] per strain ~ lognormal\nx' = -k*u*x\n"
        "observe x\n"
    )
    lines = model_summary(model).splitlines()
    assert "conditions u" in lines
    assert "grouped by strain" in lines
