"""Effort high is never worse than normal by the criterion of the fit: it does the same first, and then continues."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.arrays import Array
from gbspec.backends.module import load_module
from gbspec.data import Trajectories, sobol
from gbspec.runs import Run, files
from gbspec.training import TrainOptions, train
from gbspec.training.engines import Choice, Engine, residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, log_evidence
from gbspec.training.problem import mean_loss
from gbspec.training.recipe import planning
from gbspec.training.recipe.context import build_context
from gbspec.training.recipe.further import KEPT, Further
from tests.training.conftest import URP, model_of, problem_of, urp_data

pytestmark = pytest.mark.usefixtures("quick_fits")
SMALL = URP.replace("mlp(12, 12)", "mlp(5)")
SAME = 1 + 1e-6


def fitted(data: Trajectories, effort: str, place: Path) -> tuple[Run, Engine, Array]:
    """A fit, and the engine of whole solutions with the vector that was found."""
    model, options = model_of(SMALL), TrainOptions(effort=effort, workers=1)  # type: ignore[arg-type]
    run = train(model, data, options, place / effort)
    arrays, _ = files.read_tensors(run.path / "members" / "0" / files.CHECKPOINT)
    context = build_context(model, load_module(model), data, options, 0)
    context.estimated = run.fit.members[0].estimated(model)
    fixed = {name.partition("fixed.")[2]: v for name, v in arrays.items() if name.startswith("fixed.")}
    return run, context.engine(context.parameters(fixed, released=True), 0.0), arrays["theta"]


def stages(run: Run) -> list[tuple[str, int]]:
    return [(stage.name, stage.iterations) for stage in run.fit.members[0].stages]


def test_high_is_not_worse_without_noise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "FEW", 0)  # the criterion is the loss, without a ridge
    data = urp_data(3, 1.3, 6)
    (normal, _, _), (high, _, _) = (fitted(data, effort, tmp_path) for effort in ("normal", "high"))
    assert stages(high)[: len(stages(normal))] == stages(normal)
    assert "further iterations" in [name for name, _ in stages(high)]
    losses = [run.fit.members[0].interval_loss for run in (high, normal)]
    assert losses[0] is not None and losses[1] is not None and losses[0] <= losses[1] * SAME


def test_high_is_not_worse_with_noise(tmp_path: Path) -> None:
    data = urp_data(3, 1.3, 6, noise=0.02)
    (normal, engine, before), (high, _, after) = (fitted(data, effort, tmp_path) for effort in ("normal", "high"))
    assert stages(high)[: len(stages(normal))] == stages(normal)
    evidences = [log_evidence(engine, theta) for theta in (after, before)]
    assert evidences[0] is not None and evidences[1] is not None
    assert evidences[0] >= evidences[1] - 1e-6 * abs(evidences[1])


def test_what_is_worse_is_not_kept() -> None:
    wide = URP.replace("mlp(12, 12)", "mlp(8)")
    problem, parameters, theta = problem_of(model_of(wide), urp_data(2, 2.0, 6), 0.1)
    engine = Choice().engine(problem, parameters)
    stage = Further(LevenbergMarquardt("lm", 1, lambda i: engine, LevenbergOptions(robust=False)))
    outcome = stage.step(stage.begin(theta), 0)
    assert outcome.loss < mean_loss(residual_vector(engine, theta))
    better = outcome.state["theta"]
    state = {**stage.begin(theta), "first": better + 0.0, "theta": theta, "damping": np.array(1e12)}
    kept = stage.step(state, 0)
    assert np.array_equal(kept.state["theta"], better)
    assert (kept.done, kept.remark) == (True, KEPT)
    assert kept.loss == pytest.approx(outcome.loss)


def test_more_draws_begin_with_the_same_ones() -> None:
    assert np.array_equal(sobol(64, 3, 5), sobol(256, 3, 5)[:64])
