"""Constants that new trajectories of disturbed models have of their own: estimated from the rows that are used."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from gbspec.data import Trajectories, read
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.operations import analysing
from gbspec.runs import Run, spread_of_next
from gbspec.training import TrainOptions, filter_run, train

LEVELS = """model levels
state x in [-50, 50]
learn m = 3 in [-20, 20] per trajectory
learn s = 0.2 in [0.01, 3]
x' = m - x
diffusion x = s
observe x noise normal(0.05)
"""


def rows(label: str, level: float, seed: int, count: int = 40, step: float = 0.25) -> list[str]:
    rng, x, out = np.random.default_rng(seed), level, []
    for i in range(count):
        out.append(f"{label},{i * step},{x + 0.05 * rng.normal()!r}")
        x = level + (x - level) * math.exp(-step) + 0.4 * math.sqrt((1 - math.exp(-2 * step)) / 2) * rng.normal()
    return out


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Trajectories]:
    """A run of four trajectories with levels of 1 to 4, and two new ones, with 9 and -2."""
    folder = tmp_path_factory.mktemp("levels")
    (folder / "m.gb").write_text(LEVELS)
    model = load_model(folder / "m.gb", Findings())
    tables = {"old": [rows(f"t{k}", k, k) for k in (1, 2, 3, 4)], "new": [rows("a", 9.0, 8), rows("b", -2.0, 9)]}
    for name, parts in tables.items():
        (folder / f"{name}.csv").write_text("\n".join(["trajectory,t,x", *(row for part in parts for row in part)]))
    old, new = (read(folder / f"{name}.csv", model, Findings()) for name in tables)
    return train(model, old, TrainOptions(effort="low", threads=1), folder / "run"), new


def test_they_maximise_the_likelihood_of_the_window_with_the_prior(fitted: tuple[Run, Trajectories]) -> None:
    run, new = fitted
    found = filter_run(run, new, run.best, 12)
    learned = np.asarray(run.member(run.best).weights["per_trajectory.m"])
    center, sd = learned.mean(), float(spread_of_next(learned))
    assert found.own is not None
    for k in range(2):
        place = found.own.places[k, 0]

        def objective(u: float, place: int = place, k: int = k) -> float:
            moved = found.vector.copy()
            moved[place] = u
            level = replace(found, vector=moved).constants[k, 0]
            return found.engine.filtered(moved, seen=found.found.seen).value + 0.5 * ((level - center) / sd) ** 2

        best, h = minimize_scalar(objective, bracket=(found.vector[place] - 0.1, found.vector[place] + 0.1)).x, 1e-3
        assert found.vector[place] == pytest.approx(best, abs=1e-4)
        second = (objective(best + h) - 2 * objective(best) + objective(best - h)) / h**2
        assert found.own.roots[k, 0, 0] ** 2 == pytest.approx(1 / second, rel=0.02)


def test_predictions_have_them_with_what_is_open_of_them(fitted: tuple[Run, Trajectories]) -> None:
    """They had the mean of the training trajectories, 2.5, where levels are 9 and -2."""
    run, new = fitted
    found = analysing.predict(run, new, window=12)
    spread = run.fit.constants["s"].value / math.sqrt(2)
    for item, level in zip(found.items, (9.0, -2.0), strict=True):
        assert item.estimated == ("m",) and item.start.constants[0] == pytest.approx(level, abs=0.7)
        assert abs(item.mean[-1, 0] - level) < 2 * item.sd[-1, 0]
        assert 1.1 * spread < item.sd[-1, 0] < 2.5 * spread
    assert found.errors()["x"].covered > 0.7


def test_bands_have_them_where_nothing_else_is_known(
    fitted: tuple[Run, Trajectories], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fits with unknown functions keep no covariance."""
    run, new = fitted
    whole, certainties = analysing.predict(run, new, window=1), Run.certainties
    monkeypatch.setattr(Run, "certainties", lambda self, member: replace(certainties(self, member), covariance=None))
    some = analysing.predict(run, new, window=1)
    for one, other in zip(whole.items, some.items, strict=True):
        assert (other.sd[-1] <= one.sd[-1]).all() and other.sd[-1, 0] > 0.9 * one.sd[-1, 0] > 0.5


def test_known_trajectories_keep_what_was_learned(fitted: tuple[Run, Trajectories]) -> None:
    run, new = fitted
    old = read(run.path.parent / "old.csv", run.model, Findings())
    found = filter_run(run, old, run.best)
    assert found.own is None
    assert np.allclose(found.constants[:, 0], run.member(run.best).weights["per_trajectory.m"])
    again = filter_run(run, new, run.best, own_of=filter_run(run, new, run.best, 12))
    assert np.array_equal(again.constants, filter_run(run, new, run.best, 12).constants)
