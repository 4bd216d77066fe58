"""The legs of a trajectory, one after the other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from gbspec.training.engines.filter import ahead


def test_the_leg_after_each_leg_is_of_the_same_trajectory() -> None:
    # legs lie place by place: three trajectories of 3, 2 and 1 legs, the longest first
    places = (slice(0, 3), slice(3, 5), slice(5, 6))
    legs = SimpleNamespace(owner=np.array([0, 1, 2, 0, 1, 0]), places=3, at=lambda place: places[place])
    found = ahead._following(cast(Any, SimpleNamespace(legs=legs)))
    assert found.tolist() == [3, 4, -1, 5, -1, -1]
