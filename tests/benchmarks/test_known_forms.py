"""The models of the study of known forms: each can be compiled, and its bounds contain the truth."""

from __future__ import annotations

import pytest

from benchmarks.studies.known_forms import Form, Row, forms, table
from tests.training.conftest import model_of


def test_there_are_twenty_with_4_to_12_constants() -> None:
    counts = [len(form.constants) for form in forms().values()]
    assert len(counts) == 20 and min(counts) == 4 and max(counts) == 12


@pytest.mark.parametrize("form", forms().values(), ids=lambda form: form.name)
def test_bounds_are_six_decades_apart_around_the_truth(form: Form) -> None:
    model = model_of(form.text(form.within(1)))
    assert model.complete
    for learnable in model.learnables:
        low, high, truth = learnable.range.low, learnable.range.high, form.constants[learnable.name]
        assert high / low == pytest.approx(1e6, rel=1e-4)
        assert 9 * low < truth < high / 9


def test_the_table_counts_what_was_found() -> None:
    rows: list[Row] = [
        {"model": "a", "seed": i, "constants": 4, "loss": 1.0 + i, "reference": 1.0, "found": int(i == 0), "starts": "",
         "error": 0.0, "seconds": 2.0}
        for i in range(2)
    ]  # fmt: skip
    text = table(rows)
    assert "| a | 4 | 2 | 1 | 2 | 2 |" in text and "1 (50 %)" in text
