"""A constant that a step has taken to its bound comes back where the likelihood falls inwards."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.training.engines import FilterEngine
from gbspec.training.optimise import InnovationsFit
from tests.filter.conftest import engine_of

TEXT = """model process
time t
state X in [-5, 5] = 0
learn theta = 0.5 in [0, 10]
learn mu = 0.5 in [-5, 5]
learn s = 0.3 in [0, 5]
X' = theta*(mu - X)
diffusion X = s
observe X
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[FilterEngine, Array]:
    rng, x, rows = np.random.default_rng(3), 1.0, ["t,X"]
    a = np.exp(-0.2)
    for k in range(120):
        rows.append(f"{k * 0.2:.2f},{x + 0.1 * rng.standard_normal():.6f}")
        x = 1 + a * (x - 1) + 0.5 * np.sqrt((1 - a * a) / 2) * rng.standard_normal()
    return engine_of(tmp_path_factory.mktemp("process"), TEXT, "\n".join(rows) + "\n")


def fitted(engine: FilterEngine, theta: Array) -> Array:
    """The constants at the end of a fit that begins at a vector, and no other."""
    stage = InnovationsFit("innovations", 150, lambda: engine, [], None)
    state = stage.begin(theta) | {"waiting": np.zeros((0, engine.layout.size))}
    state |= stage._begun(np.concatenate([theta, engine.noise.first()]))
    for i in range(150):
        outcome = stage.step(state, i)
        state = outcome.state
        if outcome.done:
            break
    maps = engine.parameters.bijections(engine.parameters.shared)
    return np.asarray(maps.to_natural(torch.from_numpy(state["theta"][:3])).numpy())


@pytest.mark.parametrize(("place", "side"), [(0, 1.0), (0, -1.0), (1, -1.0), (2, 1.0)])
def test_a_constant_at_its_bound_comes_back(found: tuple[FilterEngine, Array], place: int, side: float) -> None:
    engine, vector = found
    theta = vector[: engine.parameters.size].copy()
    usual = fitted(engine, theta.copy())
    theta[place] = -side * np.log(1e-13) / 3
    assert fitted(engine, theta) == pytest.approx(usual, rel=0.01)
