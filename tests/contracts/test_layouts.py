"""Kinds of units: permitted connections, and the kinds that every layer needs."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends.module.template.directions import _weight_forms
from gbspec.ir.forms import Layout
from gbspec.passes.layouts import TooNarrow, layout


def counts(found: Layout) -> list[int]:
    return [sum(block.count for block in layer) for layer in found.hidden]


def test_free_outputs_need_no_layout() -> None:
    assert layout(["**", "**"], (8, 8), 0) is None


@pytest.mark.parametrize("kinds", [["+"], ["+-"], ["+*", "*-"], ["+-", "-+"], ["+*", "**"], ["+0*", "*+*", "+0*"]])
@pytest.mark.parametrize("hidden", [(16,), (7, 9), (12, 5, 24)])
def test_layers_have_their_widths_and_free_units_come_first(kinds: list[str], hidden: tuple[int, ...]) -> None:
    found = layout(kinds, hidden, 0)
    assert found is not None
    assert counts(found) == list(hidden)
    order = ["free", "convex", "concave", "saturating"]
    for layer in found.hidden:
        places = [order.index(block.shape) for block in layer]
        assert places == sorted(places)
        for block in layer:
            assert (block.shape == "free") == (not set(block.kind) & {"+", "-"})


@pytest.mark.parametrize("hidden", [(16,), (16, 16), (9, 9, 9)])
def test_no_layer_bounds_the_output(hidden: tuple[int, ...]) -> None:
    """Beside saturating units every layer has others: a network of which all units are saturated cannot rise again."""
    found = layout(["+"], hidden, 0)
    assert found is not None
    assert all({block.shape for block in layer} - {"saturating"} for layer in found.hidden)


def test_a_reversed_kind_needs_no_separate_units() -> None:
    found = layout(["+-", "-+"], (12, 12), 0)
    assert found is not None
    assert {block.kind for layer in found.hidden for block in layer} == {"+-"}


def test_a_layer_must_hold_every_kind() -> None:
    with pytest.raises(TooNarrow) as caught:
        layout(["+*"], (8, 1), 0)
    assert caught.value.needed == 2


def test_signs_of_weights_follow_the_kinds() -> None:
    """Weights have the sign that a monotone argument requires, and any sign for an unconstrained one."""
    found = layout(["+*"], (6,), 0)
    assert found is not None
    (first, last) = _weight_forms(found.plain(), (2, 6, 1))
    kinds = [(block.kind, block.shape) for block in found.hidden[0] for _ in range(block.count)]
    free, gain, _, turned = first
    for unit, (kind, shape) in enumerate(kinds):
        assert free[unit, 1] == turned[unit]  # every unit may depend on the second argument
        assert free[unit, 0] == 0
        assert (gain[unit, 0] != 0) == (kind == "+*")
        assert turned[unit] == (-1 if shape == "concave" else 1)
        # A reversed unit has reversed weights, so that the product increases with the argument.
        assert np.sign(gain[unit, 0]) == (turned[unit] if kind == "+*" else 0)
    free, gain, _, _ = last
    for unit, (kind, shape) in enumerate(kinds):
        assert (free[0, unit] != 0) == (kind == "0*")
        assert np.sign(gain[0, unit]) == ((-1 if shape == "concave" else 1) if kind == "+*" else 0)
