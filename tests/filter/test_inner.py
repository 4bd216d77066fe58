"""A rate that ends at its bound, where disturbances explain what it leaves, is also tried inside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.training.engines import FilterEngine
from gbspec.training.optimise import InnovationsFit, State, likeliest
from gbspec.training.optimise.inner import inner
from tests.filter.conftest import WITH_NETWORK, engine_of, table

FALLING = """model falling
time t
state E in [3, 9]
learn k = 0.5 {}
learn E0 = 7 in [4, 9]
learn d = -0.05 in [-0.5, 0.5]
{}
E' = k*(E0 + d*t - E)
diffusion E = s
observe E
"""
UNDISTURBED, DISTURBED = "const s = 0", "learn s = 0.3 in [0, 5]"


def falling(folder: Path, seed: int, bounds: str, size: str) -> tuple[FilterEngine, Array]:
    """A slow approach to a falling equilibrium, measured with errors as large as it moves in five rows."""
    rng, t = np.random.default_rng(seed), np.arange(37.0)
    slow = 7.98 - 0.1 * (t - 10) + (7.3 - 8.98) * np.exp(-0.1 * t)
    values = np.clip(slow + 0.5 * rng.standard_normal(37), 3.01, 8.99)
    rows = "\n".join(f"{time:g},{x:.4f}" for time, x in zip(t, values, strict=True))
    folder.mkdir()
    return engine_of(folder, FALLING.format(bounds, size), f"t,E\n{rows}\n")


def fitted(engine: FilterEngine, vector: Array) -> tuple[State, float]:
    """The last state of a fit, and -2 log likelihood at the maximum near it."""
    stage = InnovationsFit("innovations", 150, lambda: engine, [], None)
    state = stage.begin(vector[: engine.parameters.size])
    for i in range(150):
        outcome = stage.step(state, i)
        state = outcome.state
        if outcome.done:
            break
    return state, 2 * likeliest(engine, np.concatenate([state["theta"], state["log_sd"]])).value


@pytest.mark.parametrize(
    ("seed", "bounds"), [(0, "in [0.01, 10]"), (6, "in [0, 10]"), (14, "> 0"), (21, "in [0.01, 10]")]
)
def test_a_rate_at_its_bound_is_tried_inside(tmp_path: Path, bounds: str, seed: int) -> None:
    _, without = fitted(*falling(tmp_path / "without", seed, bounds, UNDISTURBED))
    state, value = fitted(*falling(tmp_path / "with", seed, bounds, DISTURBED))
    assert value < without + 1
    assert ("likeliest" in state) == (seed == 0)  # there the restricted likelihood leads back to the bound


def test_networks_are_left_as_they_are(tmp_path: Path) -> None:
    assert inner(*engine_of(tmp_path, WITH_NETWORK, table("X V y"))) is None
