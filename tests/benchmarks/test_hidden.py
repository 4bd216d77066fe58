"""The models of the study of dense data: each hides a state that an unknown function depends on."""

from __future__ import annotations

import pytest

from benchmarks.studies.hidden import MODELS, Row, table
from tests.training.conftest import model_of


@pytest.mark.parametrize("name", MODELS)
def test_one_state_is_never_measured(name: str) -> None:
    model = model_of(MODELS[name].text)
    measured = {channel.state for channel in model.channels}
    assert len(set(range(len(model.states))) - measured) == 1
    assert model.unknowns and not model.complete


def test_the_table_has_the_worst_of_the_fits() -> None:
    rows: list[Row] = [
        {"model": "a", "noise": 0.02, "seed": i, "r2": 0.9 + 0.05 * i, "naive": 0.1 * i, "loss_noise": 1.0 + i,
         "rhs": 0.1 * (i + 1), "rhs_reference": 0.05, "fresh": 0.84, "reference": 0.96, "loss": 2.0 - i,
         "loss_reference": 1.0, "seconds": 10 * i}
        for i in range(2)
    ]  # fmt: skip
    *_, line, empty, near, others = table(rows).splitlines()
    assert not empty
    assert line == (
        "| a | 2 % | 2 | 0.900000 | 0.100 | 2 | 0.2 | 3.00, 4.00 | 0 | 0: 2.00, 2; 1: 4.00, 1 | 2 | 0.840000 "
        "| 2.00, 2.00 | 5 |"
    )
    assert near.startswith("0 of 2 fits")
    assert others.startswith("Of the other 2, 1 end with at most 1.001 times the loss")
