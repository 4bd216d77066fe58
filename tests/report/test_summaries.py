"""Lines of a model's summary, as `check` prints them."""

from __future__ import annotations

import pytest

from gbspec.report.html.page import _learned
from gbspec.report.text import marginal_line, model_summary
from gbspec.runs import EffectRecord, PopulationRecord
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


@pytest.mark.parametrize("maximum", [True, False])
@pytest.mark.parametrize("distributed", [True, False])
def test_only_a_likelihood_with_distributions_is_said_to_be_approximated(distributed: bool, maximum: bool) -> None:
    effects = {"k": EffectRecord(1.0, 0.2, None, None)} if distributed else {}
    said = marginal_line(PopulationRecord(10.0, effects, {}, 2, exact_hessian=10.5, maximum=maximum))
    assert said.startswith("-2 log likelihood 10.0000")
    assert ("Laplace" in said) is ("Hessian" in said) is distributed
    assert ("not at its maximum" in said) is not maximum
    if maximum and not distributed:
        assert said == "-2 log likelihood 10.0000, 2 parameters"


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        ("", "", "𝒩 is the network that learns what is not known."),
        (" by spline(6)", " by spline(8)", "𝒩 is the spline that learns what is not known."),
        (" by spline(6)", "", "𝒩 learns what is not known: a spline in f, a network in g."),
    ],
)
def test_the_report_says_what_learns_what_is_not_known(first: str, second: str, said: str) -> None:
    text = f"model m\nstate x in [0, 4]\nunknown f(x){first}\nunknown g(x){second}\nx' = f - g\nobserve x\n"
    assert _learned(model_of(text)) == said
    assert not _learned(model_of("model m\nstate x\nx' = -x\nobserve x\n"))
