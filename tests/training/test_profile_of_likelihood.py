"""Profiles of fits by a marginal likelihood, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq, minimize

from gbspec.diagnostics import Findings, UserError
from gbspec.operations import fitting, tables
from gbspec.runs import NORMAL_90, Run, open_run
from gbspec.training import TrainOptions, train
from gbspec.training.profile.possible import check
from tests.training.test_populations import LEVEL, model_of

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = """model decay
time t from 0
state x in [0, 40]
learn k = 0.5 in [0.01, 5]
learn s = 1 in [0.01, 10]
x' = -k*x
initial x = 20
observe x noise normal(s)
"""
TIMES = np.arange(1.0, 9.0)
THRESHOLD = NORMAL_90**2


def fitted(folder: Path, text: str, table: str, stages: str | None = None) -> Run:
    (folder / "data.csv").write_text(table)
    model = model_of(text, folder)
    data = tables.read_data(folder / "data.csv", model, Findings())
    return train(model, data, TrainOptions(effort="low", max_step=0.05, stages=stages), folder / "run")


def ends(run: Run, name: str) -> tuple[float, float]:
    data = tables.trained_on(run, None, Findings())
    found = fitting.profile(run, name, data)
    assert found.settled and found.low is not None and found.high is not None and found.noise is None
    assert found.threshold == pytest.approx(THRESHOLD, rel=1e-3)
    return found.low, found.high


def independent(deviance: Callable[[float], float], best: float, low: float, high: float) -> tuple[float, float]:
    """Where a profile crosses the threshold on either side of its minimum."""
    return (
        float(brentq(lambda value: deviance(value) - THRESHOLD, low, best)),
        float(brentq(lambda value: deviance(value) - THRESHOLD, best, high)),
    )


def test_what_has_a_profile_is_listed_once(tmp_path: Path) -> None:
    text = LEVEL.replace("~ normal(s)", "~ normal(s) per strain ~ normal(w)\nlearn w = 0.8 > 0")
    with pytest.raises(UserError) as caught:
        check(model_of(text, tmp_path), "x")
    (found,) = caught.value.diagnostics
    assert found.help is not None and found.help.startswith("constants and spreads with a profile are ")
    assert all(found.help.count(f"`{name}`") == 1 for name in ("m", "s", "w"))


def test_of_a_learned_noise_it_is_that_of_the_logarithm_of_the_sum_of_squares(tmp_path: Path) -> None:
    x = 20 * np.exp(-0.4 * TIMES) + np.random.default_rng(2).normal(size=8)
    run = fitted(tmp_path, DECAY, "t,x\n" + "".join(f"{t},{y}\n" for t, y in zip(TIMES, x, strict=True)))

    def squares(k: float) -> float:
        return float(np.sum((x - 20 * np.exp(-k * TIMES)) ** 2))

    best = float(minimize(lambda k: squares(k[0]), [0.4], method="Nelder-Mead", options={"xatol": 1e-9}).x[0])
    of_k = independent(lambda k: 8 * np.log(squares(k) / squares(best)), best, 0.1, 1.5)
    size = squares(best)
    of_s = independent(lambda s: 8 * np.log(s**2) + size / s**2 - 8 * np.log(size / 8) - 8, (size / 8) ** 0.5, 0.1, 9.0)
    assert ends(run, "k") == pytest.approx(of_k, rel=0.01)
    assert ends(run, "s") == pytest.approx(of_s, rel=0.02)
    assert open_run(run.path).profiled("k") is not None


def test_of_a_population_it_has_its_spreads_refitted(tmp_path: Path) -> None:
    rng, each = np.random.default_rng(5), 4
    y = 5 + rng.normal(size=(7, 1)) + 0.5 * rng.normal(size=(7, each))
    rows = [f"{i},{j},{y[i, j]}\n" for i in range(7) for j in range(each)]
    run = fitted(tmp_path, LEVEL, "trajectory,t,x\n" + "".join(rows))

    def minus2ll(m: float, s: float, e: float) -> float:
        within = float(np.sum((y - y.mean(axis=1, keepdims=True)) ** 2))
        between, size = float(np.sum((y.mean(axis=1) - m) ** 2)), s**2 + e**2 / each
        return 7 * (each - 1) * np.log(e**2) + within / e**2 + 7 * np.log(size) + between / size

    def lowest(place: int, value: float) -> float:
        def with_it(rest: np.ndarray) -> float:
            free = iter(np.abs(rest))
            return minus2ll(*(value if i == place else float(next(free)) for i in range(3)))

        start = [one for i, one in enumerate((5.0, 1.0, 0.5)) if i != place]
        return float(minimize(with_it, start, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-9}).fun)

    whole = minimize(lambda p: minus2ll(*p), [5, 1, 0.5], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-10})
    bounds = {"m": (0, 0.0, 10.0), "s": (1, 0.05, 9.0), "e": (2, 0.1, 3.0)}
    for name, (place, low, high) in bounds.items():
        expected = independent(lambda v, i=place: lowest(i, v) - whole.fun, abs(float(whole.x[place])), low, high)
        assert ends(run, name) == pytest.approx(expected, rel=0.02), name


def test_a_fit_that_is_at_no_maximum_has_none(tmp_path: Path) -> None:
    x = 20 * np.exp(-0.4 * TIMES)
    table = "t,x\n" + "".join(f"{t},{y + (-1) ** int(t)}\n" for t, y in zip(TIMES, x, strict=True))
    run = fitted(tmp_path, DECAY, table, "search")
    with pytest.raises(UserError, match="GB777"):
        ends(run, "k")
    with pytest.raises(UserError, match="GB858"):
        ends(run, "x")
