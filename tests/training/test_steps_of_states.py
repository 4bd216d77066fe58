"""The step is halved where it moves a state that is not measured, as the check of each fit asks."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gbspec.data.trajectories import Trajectories
from gbspec.operations import fitting
from gbspec.runs import Run
from gbspec.training import TrainOptions
from gbspec.training.recipe import finer
from gbspec.training.recipe.finer import states_move
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

MODEL = """model tissue "A compartment that empties fast, and hardly shows in what is measured"
time t
state A in [0, 1] = 1
state C in [0, 5]
{declared}
A' = -{rate}*A
C' = 0.001*A - {lost}
initial A = 1
observe C
"""
UNKNOWN = {"declared": "unknown out(C in [0, 5]) by mlp(4)", "lost": "out"}
KNOWN = {"declared": "learn k = 0.1 in [0.001, 1]", "lost": "k*C"}
TIMES = np.array([0.0, 2.0, 12.0, 22.0, 32.0, 42.0, 52.0])


def fitted(parts: dict[str, str], rate: float, path: Path, **options: Any) -> Run:
    """A fit of noisy values of C, with a first step of 2."""
    drawn = np.random.default_rng(2)
    items = [
        trajectory(str(c), 0.0, TIMES, (c * np.exp(-0.05 * TIMES) + 0.02 * drawn.normal(size=7))[:, None], [])
        for c in (1.0, 2.0, 3.0, 4.0)
    ]
    chosen = TrainOptions(workers=1, effort="low", **options)
    return fitting.train(model_of(MODEL.format(rate=rate, **parts)), Trajectories(tuple(items), ("C",)), path, chosen)


@pytest.mark.parametrize("parts", [UNKNOWN, KNOWN], ids=["unknown", "known"])
def test_a_step_that_moves_a_state_that_is_not_measured_is_halved(parts: dict[str, str], tmp_path: Path) -> None:
    """One step changes A by 1.7 % of its range, and no measured value by a share of its noise."""
    fit = fitted(parts, 0.6, tmp_path / "run").fit
    found = [stage.remark for stage in fit.members[0].stages if stage.name == "finer step"]
    assert found == ["largest step 1, since the error of twice this step showed in states"]
    assert fit.step_checks[0].step == 1.0
    assert (fit.step_checks[0].half_step or 0.0) < 0.01
    assert not [text for text in fit.warnings if "depends on its training step" in text]


@pytest.mark.parametrize(("rate", "options"), [(0.3, {}), (0.6, {"max_step": 2.0})])
def test_a_step_stays_where_nothing_shows_or_where_it_was_given(
    rate: float, options: dict[str, Any], tmp_path: Path
) -> None:
    fit = fitted(UNKNOWN, rate, tmp_path / "run", **options).fit
    assert "finer step" not in [stage.name for stage in fit.members[0].stages]
    assert any("depends on its training step of 2" in text for text in fit.warnings) == bool(options)


@pytest.mark.parametrize(
    ("half", "quarter", "moves"),
    [
        (0.02, 0.021, True),
        (0.005, 0.005, False),
        (0.02, 0.03, False),  # a jump beside a row: no step is short enough
        (np.nan, 0.0, True),
        (0.02, np.nan, False),
    ],
)
def test_states_move_where_a_shorter_step_helps(
    half: float, quarter: float, moves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By more than a hundredth of their ranges, of which half the step leaves at most a quarter."""
    states = {"now": 0.0, "half": half, "quarter": quarter}
    rows = {name: np.array([[0.0, 1.0], [1.0 + by, 1.0]]) for name, by in states.items()}  # [2, 2], the second constant
    monkeypatch.setattr(finer, "predicted", lambda engine, theta: SimpleNamespace(before=rows[engine]))
    engine: Any = ["now", "half", "quarter"]
    assert states_move(engine[0], engine[1], lambda: engine[2], np.zeros(0)) is moves
