"""Which rows lie outside of the ranges that a run was trained on."""

from __future__ import annotations

import numpy as np

from gbspec.analysis.prediction.forecast import Trained
from gbspec.analysis.prediction.solutions import Start
from tests.data.hand_models import decay
from tests.data.test_naive import series


def test_a_range_may_be_left_by_a_hundredth_of_its_width() -> None:
    values = [0.99, 0.97, 2.0, 3.01, 3.03]
    (item,) = series(values).items
    start = Start(np.array(values[:1]), np.zeros(0), "measured")
    found = Trained({"x": (1.0, 3.0)}, None).outside(decay(), item, np.array(values)[:, None], start)
    assert found == ((), ("x",), (), (), ("x",))
