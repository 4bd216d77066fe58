"""Problems with random disturbances, small ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import read
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir import METHODS
from gbspec.training.engines import FilterEngine
from gbspec.training.options import TrainOptions
from gbspec.training.recipe import build_context

LINEAR = """model linear
time t
input u in [-2, 2] held
state X in [-5, 5] = 1
state V in [-5, 5] = 1
learn theta = 1 in [0.01, 10]
learn s = 0.3 in [0, 5]
learn r = 0.4 in [0, 5]
X' = -theta*X + 0.5*V
V' = theta*(u - V) - 0.3*X
diffusion X = s
diffusion V = r
observe X noise normal(0.1)
observe y = V - 0.2*X
"""
BENT = """model bent
time t
input u in [-2, 2] linear
state X in [-5, 5] = 1
state V in [-5, 5] = 1
learn theta = 1 in [0.01, 10]
learn s = 0.3 in [0, 5]
learn r = 0.4 in [0, 5]
X' = -theta*X^3 + 0.5*V*sin(X) + 0.1*u
V' = theta*V*(1 - V) - 0.3*X*V
initial X learn
diffusion X = s
diffusion V = r*V
observe X noise normal(0.1)
observe V noise lognormal(0.2)
observe y = X^2 + V
"""
WITH_NETWORK = BENT.replace("-theta*X^3 + 0.5*V*sin(X)", "q - theta*X").replace(
    "learn theta", "unknown q(X, V) by mlp(3)\nlearn theta"
)


def table(channels: str, rows: int = 14, trajectories: int = 2, seed: int = 0) -> str:
    """Random measurements at irregular times, some missing, with an input that changes between them."""
    rng, names = np.random.default_rng(seed), channels.split()
    lines = [f"trajectory,t,u,{','.join(names)}"]
    for k in range(trajectories):
        t = np.cumsum(rng.uniform(0.05, 0.3, rows - 3 * k))
        level = np.exp(0.2 * np.cumsum(rng.standard_normal((len(t), len(names))), axis=0))
        for i, time in enumerate(t):
            cells = [f"{x:.5f}" if rng.random() < 0.8 or not i else "" for x in level[i]]
            lines.append(f"{k},{time:.5f},{rng.uniform(-1, 1):.4f},{','.join(cells)}")
            if i % 4 == 1:
                lines.append(f"{k},{time + 0.021:.5f},{rng.uniform(-1, 1):.4f},{',' * (len(names) - 1)}")
    return "\n".join(lines) + "\n"


def engine_of(
    folder: Path,
    text: str,
    data: str,
    max_step: float | None = None,
    solver: str = "rk4",
    tolerance: float | None = None,
) -> tuple[FilterEngine, Array]:
    """The filter of a model and a table, and a vector of its likelihood."""
    (folder / "m.gb").write_text(text, encoding="utf-8")
    (folder / "d.csv").write_text(data, encoding="utf-8")
    model = load_model(folder / "m.gb", Findings())
    trajectories = read(folder / "d.csv", model, Findings())
    module = load_module(model, METHODS[solver])
    options = TrainOptions(backend="torch", max_step=max_step, solver=solver, tolerance=tolerance)
    context = build_context(model, module, trajectories, options, 0)
    scales = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    parameters = context.parameters(scales)
    engine = FilterEngine.of(context.problem(0.0), parameters)
    return engine, np.concatenate([parameters.vector(context.module.weights), engine.noise.first()])
