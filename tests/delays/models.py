"""Models with delays and their data, and an independent solution of one of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from gbspec.data.trajectories import DoseEvents, Signal, Trajectories
from tests.training.conftest import trajectory

MACKEY_GLASS = """model mackey_glass
time t from 0
state P in [0, 2]
learn tau = 12 in [5, 40]
learn beta = 0.3 in [0.05, 1]
learn gamma = 0.15 in [0.01, 0.5]
P' = beta*delay(P, tau)/(1 + delay(P, tau)^10) - gamma*P
initial P = 0.5
observe P
truth tau = 17
truth beta = 0.2
truth gamma = 0.1
"""

EVERYTHING = """model delayed
time t from 0
state x in [0, 3]
state y in [0, 2]
condition c in [0.5, 1.5]
input F linear
learn tau = 0.9 in [0.4, 2]
learn r = 0.7 in [0.4, 3] per trajectory
learn k = 0.6 in [0, 3]
let rate = k*x*y + F
unknown f(x, y) by mlp(5)
x' = -x + delay(rate, tau)*c + 0.2*f(delay(x, r), y)
y' = 0.3*delay(F, tau) - k*delay(y, tau + r) + 0.1*t
initial y = 0.5 + 0.1*c
history y = 0.8 + 0.1*t
dose y
observe x
observe z = y + delay(x, tau*c)
"""


def everything_data(seed: int = 0, dosed: bool = True) -> Trajectories:
    """Random measurements for EVERYTHING: partial rows, different lengths."""
    rng = np.random.default_rng(seed)
    items = []
    for i in range(3):
        times = np.cumsum(rng.gamma(4, 0.12, 5 + i))
        values = rng.uniform(0.3, 1.5, (len(times), 2))
        values[rng.random(values.shape) < 0.2] = np.nan
        linear = Signal(np.array([0.0, 0.5, 1.3]), rng.uniform(0, 1, 3))
        doses = DoseEvents(np.array([0.7]), np.array([0.3])) if dosed else DoseEvents(np.zeros(0), np.zeros(0))
        items.append(trajectory(str(i), 0.0, times, values, [0.7 + 0.3 * i], inputs=(linear,), doses=(doses,)))
    return Trajectories(tuple(items), ("x", "z"))


def mackey_glass(tau: float, beta: float, gamma: float, end: float, step: float = 0.01) -> tuple[Any, Any]:
    """Times and values from 0.5, by a method of steps of its own: `tau` must be a multiple of the step."""
    late, count = round(tau / step), round(end / step)
    x, rate = np.full(count + late + 1, 0.5), np.zeros(count + late + 1)

    def f(now: float, before: float) -> float:
        return beta * before / (1 + before**10) - gamma * now

    for i in range(late, count + late):
        first, last = x[i - late], x[i - late + 1]
        rate[i] = f(x[i], first) if i > late else f(x[i], 0.5)
        slope = 0.0 if i - late < late else rate[i - late] - rate[i - late + 1]
        middle = (first + last) / 2 + step / 8 * slope
        k2 = f(x[i] + step / 2 * rate[i], middle)
        k3 = f(x[i] + step / 2 * k2, middle)
        k4 = f(x[i] + step * k3, last)
        x[i + 1] = x[i] + step / 6 * (rate[i] + 2 * k2 + 2 * k3 + k4)
        rate[i + 1] = f(x[i + 1], x[i + 1 - late])
    return np.arange(count + 1) * step, x[late:]
