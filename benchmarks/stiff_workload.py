"""The stiff workload: Robertson's reaction with known equations, or with its fast rate as a network, as plain arrays.

Trajectories from different starts over [0, 1e5] with 50 rows, logarithmically spaced from 1e-5 on, of all states. The
values are solutions with the true rates; loss and gradient are taken at other rates. The network's last layer is fitted
to the true rate, so that its solutions are those of a reaction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from scipy.integrate import solve_ivp

import gbspec
from benchmarks.workload import Array
from gbspec.analysis.systems.compiled import Compiled
from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.ir.methods import STIFF
from gbspec.training.problem.forcing import teacher_forcing
from gbspec.training.problem.mesh import FLOOR, Control
from gbspec.training.problem.packing import pack
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from gbspec.training.problem.scaling import scaling_of
from gbspec.training.recipe.context import state_scales

RATES = np.array([0.04, 3e7, 1e4])
"""The true rates k1, k2, k3; the loss is taken at `OFF` times these."""
OFF = np.array([1.1, 0.8, 1.2])
SEED = 1

TEXT = """model stiff
time t from 0
state y1 in [0, 1]
state y2 in [0, 1e-4]
state y3 in [0, 1]
learn k1 = 0.01 in [1e-5, 10]
learn k2 = 1e6 in [1e4, 1e10]
{rate}
process slow: y1 -> y2 rate k1*y1
process very_fast: y2 -> y3 rate k2*y2^2
process fast: y2 -> y1 rate {fast}
observe y1
observe y2
observe y3
"""
KNOWN = {"rate": "learn k3 = 1e3 in [10, 1e7]", "fast": "k3*y2*y3"}
LEARNED = {
    "rate": "unknown back(y2, y3)\n    zero at y2 = 0, zero at y3 = 0\n    by mlp({width}, {width})",
    "fast": "back(y2, y3)",
}


@dataclass(frozen=True)
class StiffWork:
    """N trajectories with T rows; the loss is the sum of `weight * (states - value)^2`.

    `times` [T], `start` [N, 3], `value`, `weight` [N, T, 3], `rates` (two with a network, else three), `scale` [3]: an
    error e of a state x counts as e / (|x| + floor * scale) for the solvers' tolerances. `layers`: weights [out, in]
    and biases, none without a network; `input_scale` [2], `output_center`, `output_scale`: the network's fixed scales.
    """

    problem: Problem
    parameters: Parameters
    theta: Array
    times: Array
    start: Array
    value: Array
    weight: Array
    rates: Array
    scale: Array
    layers: tuple[tuple[Array, Array], ...]
    input_scale: Array
    output_center: float
    output_scale: float
    floor: float = FLOOR

    def controlled(self, rtol: float) -> Problem:
        """gbspec's problem with steps of this tolerance."""
        return replace(self.problem, control=Control(rtol, self.scale))

    def natural(self, gradient: Array) -> Array:
        """A gradient in gbspec's vector as one by weights, logarithms of rates, and starts."""
        theta = torch.from_numpy(self.theta).requires_grad_()
        constants = self.parameters.constants(theta)[0].log()
        (slopes,) = torch.autograd.grad(constants.sum() + self.parameters.starts(theta).sum(), theta)
        weights = self.parameters.n_weights
        return np.concatenate([gradient[:weights], gradient[weights:] / slopes.numpy()[weights:]])

    def off(self, states: Array, exact: Array) -> float:
        """The largest error of states [N, T, 3], relative as for the tolerances."""
        if not np.isfinite(states).all():
            return float("inf")
        return float((np.abs(states - exact) / (np.abs(exact) + self.floor * self.scale)).max())

    @cached_property
    def exact(self) -> Array:
        """The solution [N, T, 3] at the vector, by scipy's Radau method."""
        module = load_module(self.problem.model, STIFF)(self.parameters.natural(self.theta) | self.module_scales())
        return solved(rhs_of(module), self.start, self.times)

    def module_scales(self) -> dict[str, Array]:
        """The arrays of the module that are not trained."""
        return {
            name: value for name, value in self.problem.module.weights.items() if name.endswith(("center", "scale"))
        }


Rates = Callable[[float, Array], Array]


def rhs_of(module: Any) -> tuple[Rates, Rates]:
    """The right-hand side and its Jacobian, by casadi."""
    rhs, jacobian = Compiled(module.casadi_rhs()), Compiled(module.casadi_jacobian())
    return lambda t, x: rhs(t, x, [], [])[0], lambda t, x: jacobian(t, x, [], [])[0]


def solved(functions: tuple[Rates, Rates], starts: Array, times: Array) -> Array:
    """Solutions [N, T, 3] by scipy's Radau method of order 5, with errors near 1e-9."""
    rates, slopes = functions
    tight = {"rtol": 1e-10, "atol": 1e-13 * np.array([1.0, 1e-5, 1.0])}
    span = (0.0, float(times[-1]))
    return np.array([solve_ivp(rates, span, x, "Radau", times, jac=slopes, **tight).y.T for x in starts])


def model_of(width: int | None) -> Any:
    """The model, with a network of two hidden layers if there is a width."""
    parts = KNOWN if width is None else {name: text.format(width=width) for name, text in LEARNED.items()}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "stiff.gb"
        path.write_text(TEXT.format(**parts))
        return gbspec.load(path).model


@cache
def data_of(trajectories: int, rows: int) -> tuple[Array, Trajectories]:
    """Exact values from different starts at the true rates, in rows from 1e-5 to 1e5."""
    rng, times = np.random.default_rng(SEED), np.logspace(-5, 5, rows)
    first = rng.uniform(0.5, 1.0, trajectories)
    starts = np.stack([first, rng.uniform(0, 2e-5, trajectories), 1 - first], 1)
    module = load_module(model_of(None), STIFF)({"constants": RATES})
    made = []
    for i, values in enumerate(solved(rhs_of(module), starts, times)):
        unknown = np.full_like(values, np.nan)
        made.append(Trajectory(str(i), 0.0, times, values, np.ones_like(values), unknown, np.zeros(0)))
    return starts, Trajectories(tuple(made), ("y1", "y2", "y3"))


def make(width: int | None = None, trajectories: int = 16, rows: int = 50) -> StiffWork:
    """The workload, with a network of two hidden layers of this width or without one."""
    (starts, data), model = data_of(trajectories, rows), model_of(width)
    times = data.items[0].times
    module = load_module(model, STIFF).random(SEED)
    packed = pack(data, model, 2 * times[-1], method=STIFF)
    scale = state_scales(model, packed, data)
    values = np.concatenate([item.values for item in data.items])
    if width is not None:
        fit_last_layer(module.weights, values)
    problem = Problem(model, module, packed, teacher_forcing(model, packed, 0.0), scaling_of(model, packed, data))
    fixed = {name: v for name, v in module.weights.items() if name.endswith(("_center", "_scale"))}
    parameters = Parameters(model, starts, scale, np.ones_like(starts), fixed)
    rates = (OFF * RATES)[: len(model.learnables)]
    theta = parameters.vector(module.weights, rates)
    place = (packed.row_trajectory, packed.row_index)
    value, weight = (np.zeros((trajectories, rows, 3)) for _ in range(2))
    value[place], weight[place] = packed.values, 0.5 * problem.factor**2 / packed.values.size
    w, prefix = module.weights, "network.back."
    layers = () if width is None else tuple((w[f"{prefix}{i}.weight"], w[f"{prefix}{i}.bias"]) for i in range(3))
    none = np.ones(1)
    return StiffWork(
        problem,
        parameters,
        theta,
        times,
        starts,
        value,
        weight,
        rates,
        scale,
        layers,
        w.get(prefix + "input_scale", none),
        float(w.get(prefix + "output_center", none)[0]),
        float(w.get(prefix + "output_scale", none)[0]),
    )


def fit_last_layer(weights: dict[str, Array], values: Array) -> None:
    """Sets the network's scales, and its last layer such that its rate is the true one (times `OFF`) at some states."""
    prefix = "network.back."
    scale = np.abs(values[:, 1:]).max(0)
    rate = OFF[2] * RATES[2] * values[:, 1] * values[:, 2]
    weights[prefix + "input_scale"], weights[prefix + "output_scale"] = scale, np.array([rate.max()])
    inner = values[:, 1:] / scale
    for i in range(2):
        z = inner @ weights[f"{prefix}{i}.weight"].T + weights[f"{prefix}{i}.bias"]
        inner = z / (1 + np.exp(-z))
    wanted = OFF[2] * RATES[2] * np.sqrt(values[:, 1:] ** 2 + scale**2).prod(1) / rate.max()
    inputs = np.concatenate([inner, np.ones((len(inner), 1))], 1)
    # A slight penalty keeps the weights small.
    left = inputs.T @ inputs + 1e-8 * len(inputs) * np.eye(inputs.shape[1])
    found = np.linalg.solve(left, inputs.T @ wanted)
    weights[f"{prefix}2.weight"], weights[f"{prefix}2.bias"] = found[None, :-1], found[-1:]
