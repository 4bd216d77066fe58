"""Names: normal form and look-alikes."""

from __future__ import annotations

import pytest

from gbspec.syntax.names import FUNCTIONS, REFUSED, explain_look_alike, is_name, looks_like, normalise


@pytest.mark.parametrize(
    ("first", "second"),
    [("ο", "o"), ("а", "a"), ("Κ", "K"), ("xο", "xo"), ("ρ", "p"), ("k1", "kl"), ("O2", "02"), ("μ", "u"), ("Х", "X")],
)
def test_letters_that_look_alike(first: str, second: str) -> None:
    assert looks_like(first, second)
    assert looks_like(second, first)
    assert explain_look_alike(first, second)


@pytest.mark.parametrize(("first", "second"), [("a", "a"), ("µ", "μ"), ("a", "b"), ("mu", "μ"), ("α", "beta")])
def test_names_that_are_the_same_or_different(first: str, second: str) -> None:
    assert not looks_like(first, second)
    assert explain_look_alike(first, second) == ""


def test_the_explanation_names_the_letters() -> None:
    text = explain_look_alike("xο", "xo")
    assert "greek small letter omicron" in text and "latin small letter o" in text


def test_normal_form() -> None:
    assert normalise("µ") == "μ"
    assert normalise("ﬁ") == "fi"


def test_well_formed_names() -> None:
    assert all(is_name(name) for name in ("x", "μ", "größe", "x_1", "_", "变量", "na\u0308he"))
    assert not any(is_name(name) for name in ("", "1x", "a·b", "x²", "a-b", "a b"))


def test_refused_names() -> None:
    assert {"pi", "if", "nn", "net", "exp", "atan2"} <= REFUSED
    assert not {"lambda", "E", "S", "I", "N", "rate", "time"} & REFUSED
    assert FUNCTIONS["atan2"] == 2
