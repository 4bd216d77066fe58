"""Replicates do not narrow the region in which a function counts as known."""

from __future__ import annotations

import numpy as np

from gbspec.analysis.systems.fence import Fence


def test_replicates_of_a_condition_leave_the_limit_as_it_was() -> None:
    levels = np.array([4.0, 8, 12, 16, 20, 25, 30, 34, 37])
    single = Fence(levels[:, None], np.arange(9))
    double = Fence(np.repeat(levels, 2)[:, None], np.arange(18))
    between = np.array([[10.0], [28.0]])
    assert not single.beyond(between).any()
    assert not double.beyond(between).any()
    assert double.beyond(np.array([[50.0]])).all()
