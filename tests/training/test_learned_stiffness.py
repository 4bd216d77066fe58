"""Fits whose equations turn out to be stiff for the fixed step are told of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gbspec.data.trajectories import Trajectories
from gbspec.training.recipe.stiffness import stiff_as_learned
from tests.training.conftest import model_of, problem_of, trajectory

TEXT = """model decay
state x in [0, 1] = 1
unknown f(x) by mlp(3)
x' = -{rate}*x + 0.001*f
observe x
"""


@pytest.mark.parametrize(("rate", "told"), [(1.0, False), (100.0, True)])
def test_stiffness_of_what_was_learned_is_told(rate: float, told: bool) -> None:
    model = model_of(TEXT.format(rate=rate))
    times = np.array([0.5, 1.0, 1.5])
    data = Trajectories((trajectory("1", 0.0, times, np.exp(-times)[:, None], []),), ("x",))
    problem, parameters, theta = problem_of(model, data, 0.1)
    context: Any = SimpleNamespace(model=model, adaptive=False, max_step=0.2)
    found = stiff_as_learned(context, problem, parameters, theta, 0.5, np.full((3, 1), 0.5))
    assert bool(found) is told
    if told:
        assert "--solver ros34pw2" in found[0]
        assert "rates of 100" in found[0]
        context.adaptive = True
        assert not stiff_as_learned(context, problem, parameters, theta, 0.5, np.full((3, 1), 0.5))
