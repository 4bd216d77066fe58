"""docs/training.md names every stage of the recipes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.training.options import TrainOptions
from gbspec.training.recipe.context import build_context
from gbspec.training.recipe.planning import plan
from tests.training.conftest import URP, model_of, trajectory, urp_data

TEXT = (Path(__file__).parents[2] / "docs" / "training.md").read_text(encoding="utf-8")
KNOWN = """model known
state x = 1
learn k = 1 in [0, 5]
x' = -k*x
observe x
"""


def test_every_stage_is_named() -> None:
    model, data = model_of(URP), urp_data(2, 2.0, 1)
    context = build_context(model, load_module(model), data, TrainOptions(initial="bred"), 0)
    planned = plan(context, context.parameters({}))
    known, times = model_of(KNOWN), np.arange(4.0)
    decay = Trajectories((trajectory("1", 0.0, times, np.exp(-times)[:, None], []),), ("x",))
    complete = build_context(known, load_module(known), decay, TrainOptions(), 0)
    names = {stage.name for stage in (*planned, *plan(complete, complete.parameters({})))}
    assert {"teacher forcing", "autoregressive", "search"} <= names
    assert [name for name in names if f"`{name}`" not in TEXT] == []
