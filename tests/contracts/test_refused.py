"""Rejected contracts: codes and messages."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import UserError
from gbspec.passes.override import with_values
from tests.contracts.helpers import model_of, refused, whole_model

REFUSED = {
    "unknown f(u) increasing in u, decreasing in u": ("GB603", "increasing and decreasing"),
    "unknown f(u) in [2, 1]": ("GB603", "at least `2` and at most `1`"),
    "unknown f(u) >= 1, <= 1": ("GB603", "still be learned"),
    "unknown f(u) >= 1, zero at u = 0": ("GB603", "excludes 0"),
    "unknown f(u) >= 0, <= 0, zero at u = 0": ("GB603", "cannot be at least"),
    "unknown f(u in [0, 5]) >= 0, zero at u = 5, increasing in u": ("GB603", "only the value 0"),
    "unknown f(u, v) zero at u = 0, zero at u = 1, increasing in u": ("GB603", "two zeros"),
    "unknown f(u) increasing in w": ("GB601", "not an argument"),
    "unknown f(u) zero at w = 0": ("GB601", "not an argument"),
    "unknown f(u) g >= 0": ("GB602", "not an output"),
    "unknown f(u) zero at u = 2*u": ("GB604", "cannot depend on `u`"),
    "unknown f(u in [0, 9]) increasing in u = u/(K + u^2)*nn": (
        "GB605",
        "not proved to be increasing in `u` by itself",
    ),
    "unknown f(u) >= 0 = u/(K + u)*nn": ("GB605", ""),
    "unknown f(u in [0, 9]) increasing in u = sin(nn)": ("GB605", "in which direction"),
    "unknown f(u in [0, 9]) zero at u = 0 = (1 + u)*exp(nn)": ("GB605", "is not 0 for `nn = 0`"),
    "unknown f(u in [0, 9]) >= 0 = sin(nn) + u": ("GB605", "neither a term nor a factor"),
    "unknown f(u in [0, 9]) increasing in u = if(u > 1, 2*u, u)*nn": ("GB605", "jumps"),
    "unknown f(u, v) <= 0, >= -1 = 2*exp(-tanh(u))*nn": ("GB605", "never less than the upper bound `0`"),
    "unknown f(u) in [2, 9] = -u^2*nn": ("GB605", "never more than the lower bound `2`"),
    "unknown f(u) in [-k, K - 5]": ("GB607", "not proved to be above"),
    "unknown f(u, v) >= v, increasing in u, decreasing in v": ("GB607", "its bound `v` is not proved"),
    "unknown f(u, v) zero at u = v, increasing in u, increasing in v": ("GB607", "moves with `v`"),
    "unknown f(u, v) zero at u = 0, zero at v = 0, increasing in u, increasing in v": ("GB607", "several arguments"),
    "unknown f(u in [0, 9]) >= 0, zero at u = 0 = u + nn": ("GB607", "together with this bound"),
    "unknown f(u) in [0, 2], zero at u = 0 = u^2/(K^2 + u^2)*(nn + 1)": ("GB607", "together with this bound"),
    "unknown f(u, v, w) increasing in u by mlp(1)": ("GB608", "too narrow"),
}


@pytest.mark.parametrize("text", REFUSED)
def test_contracts_that_cannot_be_kept_are_rejected_with_a_reason(text: str) -> None:
    code, words = REFUSED[text]
    found = refused(text)
    assert [d.code for d in found] == [code]
    assert words in found[0].message
    assert found[0].help


def test_a_range_makes_the_proof_possible() -> None:
    text = "unknown f(u{}) >= 0, increasing in u = u/(K + u)*nn"
    (missing,) = refused(text.format(""))
    assert "`u in [0, 10]`" in missing.help
    assert model_of(text.format(" in [0, 10]")).unknowns[0].form is not None


def test_a_value_set_later_is_checked_again() -> None:
    """`--set` may invalidate a proof."""
    text = "model m\nstate x in [0, 9]\nconst c = 1\nunknown f(x) >= 0 = x/(c + x)*nn\nx' = -f(x)\nobserve x\n"
    model = whole_model(text)
    assert with_values(model, {"c": 2.0}).unknowns[0].form is not None
    with pytest.raises(UserError) as caught:
        with_values(model, {"c": -1.0})
    assert [d.code for d in caught.value.diagnostics] == ["GB605"]


def test_every_output_is_reported() -> None:
    found = refused("unknown f, g(u) f in [2, 1], g increasing in u, g decreasing in u")
    assert sorted(d.subject or "" for d in found) == ["f", "g"]
