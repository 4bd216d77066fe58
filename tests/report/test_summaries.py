"""Lines of a model's summary, as `check` prints them."""

from __future__ import annotations

import pytest

from gbspec.report.text import model_summary
from tests.texts import model_of


@pytest.mark.parametrize(
    ("declared", "shown"),
    [
        ("per trajectory ~ lognormal", "per trajectory ~ lognormal(sd_k)"),
        ("per person ~ lognormal(0.3)", "per person ~ lognormal(0.3)"),
        ("per person ~ lognormal", "per person ~ lognormal(sd_k_person)"),
        (
            "per trajectory ~ lognormal(0.2) per person ~ lognormal",
            "per trajectory ~ lognormal(0.2) per person ~ lognormal(sd_k_person)",
        ),
    ],
)
def test_what_a_constant_differs_by_is_shown_as_it_is_declared(declared: str, shown: str) -> None:
    model = model_of(
        f"model m\nstate x\nlearn k = 1 in [0.1, 9] {declared}\nx' = -k*x\ninitial x = 1\nobserve x noise normal(0.1)\n"
    )
    assert f"learned k from 1 in [0.1, 9] {shown}" in model_summary(model).splitlines()
