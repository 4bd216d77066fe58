"""Measured states that events set: curves in pieces, and a search from them."""

from __future__ import annotations

import numpy as np
import torch
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.training import TrainOptions
from gbspec.training.recipe import prepare
from gbspec.training.starts import fit_curves
from gbspec.training.starts.jumps import gaps
from tests.training.conftest import model_of, trajectory

TURBIDOSTAT = """
model turbidostat
time t : h from 0
state X in [0, 4]
state S in [0, 12]
learn Y = 0.3 in [0.05, 1]
learn hi = 1.6 in [1, 3]
learn part = 0.5 in [0.05, 0.95]
unknown mu(S) >= 0, zero at S = 0 by mlp(8)
X' = mu*X
S' = -mu*X/Y
initial X learn
initial S learn
event dilute when X >= hi: X = part*X, S = part*S + (1 - part)*10
observe X
observe S
"""


def growth(s: Array) -> Array:
    """The true specific growth rate."""
    return np.asarray(0.7 * s / (1.5 + s))


def diluted(start: tuple[float, float], times: Array) -> tuple[Array, Array]:
    """The solution at `times` [R, 2], and the times of dilution."""

    def rates(_: float, x: Array) -> list[float]:
        grown = float(growth(x[1])) * x[0]
        return [grown, -grown / 0.45]

    def full(_: float, x: Array) -> float:
        return float(x[0]) - 1.8

    full.terminal, full.direction = True, 1  # type: ignore[attr-defined]
    now, x, out, when = 0.0, np.array(start), np.zeros((len(times), 2)), []
    while True:
        found = solve_ivp(rates, (now, times[-1]), x, events=full, rtol=1e-9, atol=1e-10, dense_output=True)
        here = (times >= now) & (times <= found.t[-1])
        out[here] = found.sol(times[here]).T
        if found.status != 1:
            return out, np.array(when)
        now = float(found.t[-1])
        when.append(now)
        x = 0.35 * found.y[:, -1] + [0.0, 6.5]


def tables() -> tuple[Trajectories, list[Array]]:
    """Four turbidostats with noise of 2 % of the deviations, and their times of dilution."""
    rng, items, events = np.random.default_rng(1), [], []
    for i, start in enumerate([(0.4, 8.0), (0.6, 6.0), (0.3, 9.0), (0.2, 8.5)]):
        times = np.sort(rng.uniform(0, 12, 60))
        values, when = diluted(start, times)
        items.append(trajectory(str(i), 0.0, times, values + rng.normal(size=values.shape) * [0.008, 0.024], []))
        events.append(when)
    return Trajectories(tuple(items), ("X", "S")), events


def test_curves_are_cut_where_states_jump() -> None:
    data, events = tables()
    found = gaps(model_of(TURBIDOSTAT), data, [item.values for item in data.items])
    for item, each, every in zip(data.items, found, events, strict=True):
        when = every[(every > item.times[0]) & (every <= item.times[-1])]
        missed = [t for t in when if not ((each[:, 0] < t) & (t <= each[:, 1])).any()]
        assert len(missed) <= 1
        assert len(each) < len(when) + 8


def test_one_row_between_jumps_and_unmeasured_values_have_pieces() -> None:
    values = np.array([[0.2, 8], [1.0, np.nan], [0.1, 9], [1.7, 5], [0.3, 9], [0.4, np.nan]])
    data = Trajectories((trajectory("1", 0.0, np.arange(6.0), values, []),), ("X", "S"))
    for curve in fit_curves(model_of(TURBIDOSTAT), data, "pieces").items[0]:
        assert curve is not None
        assert np.isfinite(curve.value(np.linspace(-1, 7, 50))).all()
        assert np.isfinite(curve.slope(np.linspace(-1, 7, 50))).all()


def test_jumps_do_not_hide_the_rates_between_them() -> None:
    """Slopes of curves through all rows had the growth rate negative wherever the density was high."""
    data, _ = tables()
    model = model_of(TURBIDOSTAT)
    ready = prepare(model, load_module(model), data, TrainOptions(), 0)
    assert ready.context.kind == "pieces"
    member = type(ready.context.module)(ready.parameters.natural(ready.theta))
    points = np.linspace(5.5, 8.5, 7)[:, None]
    learned = member.functions["mu"](torch.from_numpy(points)).detach().numpy()
    np.testing.assert_allclose(learned, growth(points[:, 0]), rtol=0.2)
