"""The common workload of all variants: one training step of the sparsely measured reactor with unknown kinetics.

`urp_gb2`: two states, an MLP 3-64-64-1 with SiLU, learnable B and beta, learned initial states. 200 trajectories over
[0, 10], gamma-distributed key times with mean 0.5, one channel per key time, Runge-Kutta steps of at most 0.1. A step
is the loss over all measured values and its gradient with respect to everything learned.

`Workload` holds plain arrays, so that peers do not depend on gbspec, and gbspec's own problem with the same data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import gbspec
from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.ir.model import Model
from gbspec.training.problem.forcing import teacher_forcing
from gbspec.training.problem.packing import pack
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from gbspec.training.problem.scaling import scaling_of

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MAX_STEP = 0.1
SEED = 1

REGION = {"initial": {"x1": (0.2, 0.95), "x2": (0.3, 3.5)}, "reject": ("x2 > 4",)}
"""As in the cases of the model: outside, the true reactor ignites and steps of 0.1 are unstable."""

TEXT = """model reactor_chain
state x1 in [0, 1] = 0.6
state x2 in [0, 4] = 1.5
{states}condition Da in [0.2, 0.5]
learn B = 5 in [0, 50]
learn beta = 1 in [0, 10]
unknown phi(x1, x2, Da) by mlp({width}, {width})
x1' = -x1 + phi
x2' = -x2 + B*phi - beta*x2
{balances}observe x1
observe x2
{observations}truth phi(x1, x2, Da) = Da*(1 - x1)*exp(x2)
truth B = 11
truth beta = 3
"""
"""`urp_gb2` with networks of any width; states beyond two follow the temperature in a chain."""


@dataclass(frozen=True)
class Size:
    """The size of the workload; the README quotes the default."""

    trajectories: int = 200
    span: float = 10.0
    width: int = 64
    states: int = 2


@dataclass(frozen=True)
class Workload:
    """N trajectories, T packed sub-steps, n states, M measured values.

    `h` [T, N]: lengths of the sub-steps (0 at the end only); `value`, `mask` [T + 1, N, n]: measured values on
    arrival after s sub-steps, and 1 if there is one; residuals are divided by `scale` [n]. `blend` is 1 if states are
    reset to measured values (teacher forcing), else 0. `layers`: weights [out, in] and biases [out];
    `input_center`, `input_scale`, `output_center`, `output_scale`: the network's fixed scales; `constants`: B, beta;
    `start` [N, n].
    `interval` [K, N], `count` [K, N]: time and number of sub-steps from one key row of a trajectory to its next;
    `row_value`, `row_mask` [K, N, n]: the values measured in that row.
    """

    size: Size
    problem: Problem
    parameters: Parameters
    theta: Array
    blend: float
    h: Array
    condition: Array
    value: Array
    mask: Array
    scale: Array
    layers: tuple[tuple[Array, Array], ...]
    input_center: Array
    input_scale: Array
    output_center: Array
    output_scale: Array
    constants: Array
    start: Array
    interval: Array
    count: Integers
    row_value: Array
    row_mask: Array

    @property
    def measured(self) -> int:
        """Number of measured values."""
        return int(self.mask.sum())

    @property
    def substeps(self) -> int:
        """Number of sub-steps of all trajectories together."""
        return int((self.h > 0).sum())

    @property
    def flop(self) -> float:
        """Floating point operations in matrix products, forward and backward, of the necessary sub-steps."""
        weights = sum(weight.size for weight, _ in self.layers)
        return 3.0 * 2.0 * weights * 4 * self.substeps

    @property
    def weight(self) -> Array:
        """The weight of each squared residual in the loss [T + 1, N, n]: the loss is the sum of the products."""
        return 0.5 * self.mask / self.scale**2 / self.measured

    def autoregressive(self) -> Workload:
        """The same workload without teacher forcing."""
        return replace(self, blend=0.0, problem=self.problem.forced(0.0))

    def flat(self, parts: Sequence[Any]) -> Array:
        """A gradient in the order weight, bias (by layer), B and beta, initial states, as one vector of float64."""
        return np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in parts])

    def natural(self, gradient: Array) -> Array:
        """Converts a gradient with respect to gbspec's parameter vector to one with respect to natural values."""
        theta = torch.from_numpy(self.theta).requires_grad_()
        known = len(self.parameters.model.constants)
        constants = self.parameters.constants(theta)[0, known:]
        total = constants.sum() + self.parameters.starts(theta).sum()
        (slope,) = torch.autograd.grad(total, theta)
        slopes = slope.numpy().copy()
        slopes[: self.parameters.n_weights] = 1.0
        return gradient / slopes


def model_of(size: Size) -> Model:
    """The model: the bundled `urp_gb2` for its own size."""
    if (size.width, size.states) == (64, 2):
        return gbspec.load("urp_gb2").model
    extra = range(3, size.states + 1)
    text = TEXT.format(
        width=size.width,
        states="".join(f"state x{i} in [0, 4] = 1.5\n" for i in extra),
        balances="".join(f"x{i}' = x{i - 1} - x{i}\n" for i in extra),
        observations="".join(f"observe x{i}\n" for i in extra),
    )
    with TemporaryDirectory() as folder:
        path = Path(folder) / "reactor_chain.gb"
        path.write_text(text)
        return gbspec.load(path).model


def measurements(model: Model, trajectories: int, span: float, seed: int = SEED) -> Trajectories:
    """Simulated data from time 0 on, one channel (drawn at random) per key time."""
    made = gbspec.api.Specification("", model).simulate(
        trajectories=trajectories, span=span, dt=0.5, sampling="gamma", seed=seed, **REGION
    )
    rng = np.random.default_rng(seed)
    items = []
    for item in made.items:
        seen = np.zeros(item.values.shape, dtype=bool)
        seen[np.arange(len(seen)), rng.integers(0, seen.shape[1], len(seen))] = True
        values = np.where(seen, item.values, np.nan)
        items.append(replace(item, start=0.0, values=values, counts=seen.astype(np.float64)))
    return replace(made, items=tuple(items))


def make(size: Size | None = None, simulated: int = 200) -> Workload:
    """The workload; at most `simulated` trajectories are simulated, and repeated if more are requested."""
    size = size or Size()
    model = model_of(size)
    return of_data(size, model, measurements(model, min(size.trajectories, simulated), size.span))


def of_data(size: Size, model: Model, data: Trajectories) -> Workload:
    """The workload for given data."""
    module = load_module(model).random(SEED)
    packed = pack(data, model, MAX_STEP)
    fixed = {name: v for name, v in module.weights.items() if name.endswith(("_center", "_scale"))}
    problem = Problem(model, module, packed, teacher_forcing(model, packed), scaling_of(model, packed, data))
    ranges = np.array([[state.range.low, state.range.high] for state in model.states if state.range is not None])
    start = np.array([state.start for state in model.states], dtype=np.float64)
    count = len(data)
    parameters = Parameters(
        model, np.tile(start, (count, 1)), np.ptp(ranges, axis=1) / 4, np.ones((count, len(start))), fixed
    )
    theta = parameters.vector(module.weights)
    if size.trajectories > count:
        index = np.resize(np.arange(count), size.trajectories)
        problem = problem.take(index)
        theta, parameters = parameters.take_vector(theta, index), parameters.take(index)
    return _arrays(size, problem, parameters, theta)


def _arrays(size: Size, problem: Problem, parameters: Parameters, theta: Array) -> Workload:
    packed = problem.packed
    shape = (packed.depth + 1, packed.trajectories, len(problem.model.states))
    value, mask = np.zeros(shape), np.zeros(shape)
    at = (packed.row_step, packed.row_trajectory)
    seen = packed.weights > 0
    value[at], mask[at] = np.where(seen, packed.values, 0.0), seen
    rows = (int(packed.row_index.max()) + 1, packed.trajectories)
    end, steps = np.zeros((rows[0] + 1, rows[1])), np.zeros((rows[0] + 1, rows[1]), dtype=np.int64)
    row_value, row_mask = np.zeros((*rows, shape[2])), np.zeros((*rows, shape[2]))
    place = (packed.row_index, packed.row_trajectory)
    row_value[place], row_mask[place] = np.where(seen, packed.values, 0.0), seen
    end[packed.row_index + 1, packed.row_trajectory] = packed.row_time
    steps[packed.row_index + 1, packed.row_trajectory] = packed.row_step
    weights = problem.module.weights
    prefix = f"network.{problem.model.networks[0].name}."
    layers = len(problem.model.networks[0].sizes) - 1
    return Workload(
        size=size,
        problem=problem,
        parameters=parameters,
        theta=theta,
        blend=1.0,
        h=packed.h,
        condition=packed.condition,
        value=value,
        mask=mask,
        scale=problem.scaling.channel,
        layers=tuple((weights[f"{prefix}{i}.weight"], weights[f"{prefix}{i}.bias"]) for i in range(layers)),
        input_center=weights[prefix + "input_center"],
        input_scale=weights[prefix + "input_scale"],
        output_center=weights[prefix + "output_center"],
        output_scale=weights[prefix + "output_scale"],
        constants=np.array([k.start for k in problem.model.learnables], dtype=np.float64),
        start=parameters.start_value,
        interval=np.maximum(np.diff(end, axis=0), 0.0),
        count=np.maximum(np.diff(steps, axis=0), 0),
        row_value=row_value,
        row_mask=row_mask,
    )
