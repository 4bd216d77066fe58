"""The sum of squares jumps where the time of an event that sets a measured state passes a row."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.ir import RK4
from gbspec.training import TrainOptions
from gbspec.training.recipe import prepare
from gbspec.training.recipe.preparation import Prepared
from gbspec.training.starts import Search, at_jumps
from gbspec.training.starts.search import Patience
from tests.training.conftest import model_of, trajectory

TEXT = """model kick
time t from 0
state x = 1
learn k in [0.01, 2] = 0.3
learn t0 in [0.2, 9.8] = 6
x' = -k*x
event kick at t0: x = x + 1
observe x
"""
TIMES = np.arange(0.5, 10.0, 0.5)


def measured() -> Array:
    """A decay at 0.4 that is kicked at 3.4, with noise of 0.03."""
    exact = np.exp(-0.4 * TIMES) + np.where(TIMES > 3.4, np.exp(-0.4 * (TIMES - 3.4)), 0.0)
    return np.asarray(exact + 0.03 * np.random.default_rng(0).standard_normal(len(TIMES)))


def prepared() -> Prepared:
    model = model_of(TEXT)
    data = Trajectories((trajectory("1", 0.0, TIMES, measured()[:, None], []),), ("x",))
    return prepare(model, load_module(model, RK4), data, TrainOptions(solver="rk4", max_step=0.1), 0)


def with_constants(ready: Prepared, k: float, t0: float) -> Array:
    return ready.parameters.vector({}, np.array([k, t0]))


@pytest.mark.parametrize(("t0", "places"), [(3.4, []), (4.0 - 1e-9, [1]), (4.0 + 1e-9, [1])])
def test_a_constant_beside_a_jump_is_found(t0: float, places: list[int]) -> None:
    ready = prepared()
    assert at_jumps(ready.context.engine(ready.parameters, 0.0), with_constants(ready, 0.4, t0)) == places


def test_a_search_that_ended_at_a_jump_tries_other_pieces() -> None:
    """One start alone, which ends at an end of the piece in which it began, or of one beside it."""
    ready = prepared()
    engine = ready.context.engine(ready.parameters, 0.0)
    search = Search(engine, None, 0, "low", patience=Patience(6, 1, 1, 1))
    start = with_constants(ready, 0.3, 6.2)
    state = {**search.begin(start), "starts": start[None], "theta": start, "best": np.array(np.inf)}
    found = search.step(state, 0)
    k, t0 = ready.parameters.natural(found.state["theta"])["constants"]
    assert found.done and t0 == pytest.approx(3.4, abs=0.1) and k == pytest.approx(0.4, abs=0.05)


def test_a_constant_that_ended_at_a_jump_has_no_interval(tmp_path: Path) -> None:
    """The kick was larger than in the model, which makes up for it by a later one: up to the next row, at 3.5."""
    (tmp_path / "m.gb").write_text(TEXT.replace("learn k in [0.01, 2] = 0.3", "const k = 0.4"))
    values = measured() + np.where(TIMES > 3.4, 0.5 * np.exp(-0.4 * (TIMES - 3.4)), 0.0)
    rows = "".join(f"{t},{x:.5f}\n" for t, x in zip(TIMES, values, strict=True))
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    run = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low")
    fit = json.loads((tmp_path / "run" / "fit.json").read_text())
    assert run.constants["t0"] == pytest.approx(3.5, abs=1e-6)
    assert "`t0` ended at 3.5, where the sum of squares jumps" in " ".join(fit["warnings"])
    assert fit["constants"]["t0"]["interval"] is None
    found = run.predict(tmp_path / "d.csv")
    assert (found.items[0].sd < 0.3).all(), "a change of the time moves the kick past a row: that is no derivative"


def test_exact_data_jump_nowhere() -> None:
    """Their sum of squares is of the size of rounding, and changes by any part of itself."""
    model = model_of(TEXT)
    exact = np.exp(-0.4 * TIMES) + np.where(TIMES > 3.4, np.exp(-0.4 * (TIMES - 3.4)), 0.0)
    data = Trajectories((trajectory("1", 0.0, TIMES, np.round(exact, 7)[:, None], []),), ("x",))
    ready = prepare(model, load_module(model, RK4), data, TrainOptions(solver="rk4", max_step=0.1), 0)
    assert at_jumps(ready.context.engine(ready.parameters, 0.0), with_constants(ready, 0.4, 3.4)) == []


def test_predictions_do_not_depend_on_where_between_rows_an_event_is(tmp_path: Path) -> None:
    """The time and the size of a kick can be exchanged between two rows, without a change at any row."""
    text = TEXT.replace("x = x + 1", "x = x + size").replace("in [0.2, 9.8] = 6", "in [2, 5] = 3.4")
    (tmp_path / "m.gb").write_text(text.replace("x' =", "learn size in [0, 5] = 1\nx' ="))
    rows = "".join(f"{t},{x:.5f}\n" for t, x in zip(TIMES, measured(), strict=True))
    (tmp_path / "d.csv").write_text("t,x\n" + rows)
    run = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low")
    fit = json.loads((tmp_path / "run" / "fit.json").read_text())
    assert fit["constants"]["t0"]["interval"] is None and fit["constants"]["size"]["interval"] is None
    found = run.predict(tmp_path / "d.csv")
    assert (found.items[0].sd < 0.1).all()
    assert any("`t0`" in said and "no interval" in said for said in found.warnings)
