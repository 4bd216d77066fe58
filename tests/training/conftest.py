"""Small models and data for the tests of training: the CSTR of the paper, and one with everything a model can have."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from gbspec.backends.module import load_module
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories, Trajectory
from gbspec.diagnostics import Findings, Source
from gbspec.ir.methods import RK4, Method
from gbspec.ir.model import Model
from gbspec.lower import lower
from gbspec.semantics import check
from gbspec.syntax.parser import parse
from gbspec.training import Update
from gbspec.training.problem.forcing import teacher_forcing
from gbspec.training.problem.packing import pack
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from gbspec.training.problem.scaling import scaling_of

URP = """model small_urp
state x1 in [0, 1]
state x2
condition Da in [0.2, 0.5]
learn B = 5 in [0, 50]
learn beta = 1 in [0, 10]
unknown phi(x1, x2, Da) by mlp(12, 12)
x1' = -x1 + phi
x2' = -x2 + B*phi - beta*x2
observe x1
observe x2
"""

EVERYTHING = """model everything
time t from 0
state a in [0, 2]
state b in [0, 2]
state h = 0.3
condition c in [0, 1]
input F held
input G linear
const k0 = 0.7
learn k1 = 0.5 in [0, 3]
learn k2 = 0.8 > 0
learn k3 = 0.1
learn own = 0.4 > 0 per trajectory
unknown p, q(a, h) by mlp(5, 4, activation=tanh)
unknown s(b) = 0.5*b*nn by mlp(4)
a' = -k1*a + 0.3*p + F*c - own*a*h + 0.1*t
b' = k0*a - k2*b + 0.2*s(b) - 0.1*s(a)
h' = k3 - 0.5*h + 0.3*q + 0.1*G
initial h = 0.2 + 0.1*k1 + 0.05*c
observe a
observe total = a + b*k2 + s(b)
observe b noise lognormal(0.1)
"""


class Recorder:
    """Progress that remembers, and interrupts the process after a number of updates."""

    def __init__(self, interrupt_after: int | None = None) -> None:
        self.updates: list[Update] = []
        self.messages: list[str] = []
        self.interrupt_after = interrupt_after

    def update(self, update: Update) -> None:
        self.updates.append(update)
        if len(self.updates) == self.interrupt_after:
            os.kill(os.getpid(), signal.SIGINT)

    def message(self, text: str) -> None:
        self.messages.append(text)


def model_of(text: str) -> Model:
    """The Model of a text; raises UserError if it is wrong."""
    findings = Findings()
    file = parse(Source("test.gb", text), findings)
    findings.raise_if_failed()
    assert file is not None
    checked = check(file, findings, lambda path: Source(str(path), ""))
    findings.raise_if_failed()
    assert checked is not None
    model = lower(checked, findings)
    findings.raise_if_failed()
    return model


def urp_rhs(t: float, x: Any, Da: float) -> list[float]:
    """The truth: B = 11, beta = 3."""
    rate = Da * (1 - x[0]) * np.exp(x[1])
    return [-x[0] + rate, -x[1] + 11 * rate - 3 * x[1]]


@cache
def urp_data(count: int, span: float, seed: int, noise: float = 0.0, together: bool = False) -> Trajectories:
    """Trajectories of the CSTR, channels on their own gamma clocks of mean 0.4 (or `together`), starts not measured."""
    rng = np.random.default_rng(seed)
    items: list[Trajectory] = []
    while len(items) < count:
        start, Da = [rng.uniform(0.2, 0.95), rng.uniform(0.3, 3.5)], rng.uniform(0.2, 0.5)
        found = solve_ivp(
            urp_rhs, (0, span), start, args=(Da,), rtol=1e-9, atol=1e-11, dense_output=True, method="LSODA"
        )
        if found.y[1].max() > 4:
            continue
        clocks = [t[t <= span] for t in (np.cumsum(rng.gamma(4, 0.1, 100)) for _ in range(2))]
        clocks = [clocks[0], clocks[0]] if together else clocks
        times = np.union1d(*clocks)
        values = np.full((len(times), 2), np.nan)
        exact = found.sol(times).T + noise * rng.standard_normal((len(times), 2)) * [0.25, 0.8]
        for i, clock in enumerate(clocks):
            seen = np.isin(times, clock)
            values[seen, i] = exact[seen, i]
        items.append(trajectory(str(len(items)), 0.0, times, values, [Da]))
    return Trajectories(tuple(items), ("x1", "x2"), "made.csv", f"{seed:064x}")


def trajectory(label: str, start: float, times: Any, values: Any, condition: Any, **more: Any) -> Trajectory:
    """A trajectory whose counts are 1 where something was measured."""
    values = np.asarray(values, dtype=np.float64)
    seen = np.isfinite(values)
    return Trajectory(
        label,
        start,
        np.asarray(times, dtype=np.float64),
        values,
        seen.astype(np.float64),
        np.full_like(values, np.nan),
        np.asarray(condition, dtype=np.float64),
        **more,
    )


def everything_data(seed: int = 0) -> Trajectories:
    """Random measurements for EVERYTHING: partial rows, different lengths, inputs that jump between rows."""
    rng = np.random.default_rng(seed)
    items = []
    for i in range(3):
        times = np.cumsum(rng.gamma(4, 0.1, 5 + i))
        if i == 1:
            times = np.concatenate([[0.0], times])
        values = rng.uniform(0.3, 1.5, (len(times), 3))
        values[rng.random(values.shape) < 0.4] = np.nan
        held = Signal(np.array([0.0, 0.35, 0.9]), rng.uniform(0, 1, 3))
        linear = Signal(np.array([0.1, 0.5, 1.3]), rng.uniform(0, 1, 3))
        doses: tuple[DoseEvents, ...] = ()
        items.append(trajectory(str(i), 0.0, times, values, [rng.uniform()], inputs=(held, linear), doses=doses))
    return Trajectories(tuple(items), ("a", "total", "b"))


def problem_of(
    model: Model, data: Trajectories, max_step: float, seed: int = 0, blend: float = 1.0, method: Method = RK4
) -> tuple[Problem, Parameters, np.ndarray[Any, Any]]:
    """A problem at random weights and starts, with non-trivial scales."""
    rng = np.random.default_rng(seed)
    module = load_module(model, method).random(seed)
    for name in list(module.weights):
        if name.endswith(("_scale", "_center")):
            shift = 1.3 if name.endswith("_scale") else 0.4
            module.weights[name] = module.weights[name] * 0.0 + shift
    packed = pack(data, model, max_step, method=method)
    problem = Problem(model, module, packed, teacher_forcing(model, packed, blend), scaling_of(model, packed, data))
    n = len(model.states)
    free = np.ones((len(data), n))
    for i, state in enumerate(model.states):
        if state.initial.known:
            free[:, i] = 0.0
    free[0, 0] = 0.0
    fixed = {k: v for k, v in module.weights.items() if k.endswith(("_scale", "_center"))}
    parameters = Parameters(model, rng.uniform(0.4, 0.8, (len(data), n)), rng.uniform(0.2, 0.6, n), free, fixed)
    theta = parameters.vector(module.weights)
    theta = theta + 0.1 * rng.standard_normal(len(theta))
    return problem, parameters, theta


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def build() -> Callable[[str], Model]:
    return model_of
