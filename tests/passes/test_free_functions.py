"""Functions that data leave free are those that can move at every point."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.passes.identifiability import directions
from gbspec.passes.identifiability.jets import Germ, LinearSystem


def system(*row: float) -> LinearSystem:
    """One equation in a coefficient of `f` and one of `g`."""
    germs = [
        Germ(name, (0.0,), (1.0,), [(0,)], np.ones(1), column, np.ones(1, dtype=bool))
        for column, name in enumerate("fg")
    ]
    return LinearSystem(np.array([row]), germs, 0, {}, [], {}, np.ones(len(row)), np.zeros((1, 0)))


@pytest.mark.parametrize(
    ("systems", "free"),
    [
        ([system(1.0, 0.0)], ("g",)),
        ([system(1.0, 0.0), system(0.0, 1.0)], ()),
        ([system(1.0, 0.0), system(2.0, 0.0)], ("g",)),
        ([system(1.0, -1.0)], ("f", "g")),
        ([system(1.0, -1.0), system(1.0, 0.0)], ("g",)),
    ],
)
def test_a_function_is_free_if_it_can_move_at_every_point(systems: list[LinearSystem], free: tuple[str, ...]) -> None:
    assert directions._loose(systems) == (free, ())
