"""The negative log likelihood of whole solutions at given constants, chi-squared, and the exact gradient.

Solutions run from the starts of the trajectories to their ends; measurements reset nothing. Steps are adaptive, first
by a method of order 5, and by a stiff one if that finds no solution. The tolerance falls by a factor of ten until
the predictions and the likelihood no longer change by more than `ACCURACY`, relative to their sizes. With delays steps
are equal, and halved: the control of adaptive steps does not see the past. Steps end where right-hand sides switch, so
that derivatives know how the times of that move.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from gbspec.arrays import Array, as_measured
from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.diagnostics import ComputationError
from gbspec.ir import DOPRI5, STIFF, Method, Model
from gbspec.passes import with_switches
from gbspec.training.engines import choose, happened
from gbspec.training.evaluation.density import Density
from gbspec.training.evaluation.lacking import Lacking
from gbspec.training.options import TrainOptions
from gbspec.training.population import Individuals, Measured
from gbspec.training.problem import Control, Integers, Problem, pack, scaling_of, teacher_forcing

ACCURACY = 1e-7
"""The change by a tenth of the tolerance at which a result is accepted."""
TOLERANCES: Mapping[str, tuple[float, ...]] = {
    DOPRI5.name: (1e-8, 1e-9, 1e-10, 1e-11, 1e-12),
    STIFF.name: (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10),
}
"""The relative tolerances that are tried, method by method."""
PARTS = (16, 32, 64, 128, 256, 512, 1024, 2048, 4096)
"""The numbers of equal steps that are tried for the longest trajectory, for models with delays."""


@dataclass(frozen=True)
class Given:
    """Where a model is evaluated: the learnable constants [N, K] and starts [N, n] of the trajectories, the weights and
    scales of its networks, standard deviations of channels that do not state their noise, and the parameters of a
    population by name."""

    constants: Array
    starts: Array
    weights: Mapping[str, Array]
    noise: Mapping[str, float]
    population: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Value:
    """A measured value with its prediction; `sd` is that of its logarithm under lognormal noise, as is `residual`, the
    prediction minus the measurement over it. `limit` is `<` or `>` where the value is a limit below or above which the
    measured one lies: there half the square of the residual is minus the logarithm of the probability."""

    trajectory: str
    t: float
    channel: str
    value: float
    measured: float
    sd: float
    residual: float
    limit: str = ""


@dataclass(frozen=True)
class Evaluated:
    """The objective at a point; `accuracy` is its last relative change by a tenth of the tolerance, `solver` the
    method of the steps. Derivatives that are `lacking` are NaN in the gradient."""

    nllh: float
    chi2: float
    gradient: Mapping[str, float]
    simulation: tuple[Value, ...]
    accuracy: float
    solver: str
    lacking: Lacking = field(default_factory=Lacking)


@dataclass(frozen=True)
class _Trial:
    """Predictions [m] and their derivatives [m, K] by the constants of their own trajectory; `slides`: whether steps go
    across a switch of right-hand sides."""

    mean: Array
    by_constants: Array
    slides: bool


def evaluate(model: Model, trajectories: Trajectories, given: Given) -> Evaluated:
    """The objective at a point. Raises ComputationError if there is no solution from the starts there."""
    switched = with_switches(model)
    model = model if switched.model is None else switched.model
    reached: Evaluated | None = None
    for method in (DOPRI5,) if _equal_steps(model) else (DOPRI5, STIFF):
        previous: Evaluated | None = None
        for problem, trial in _trials(model, trajectories, given, method):
            if not np.isfinite(trial.mean).all():
                previous = None
                if _equal_steps(model):
                    continue
                break
            found = _judged(model, problem, trial, given, method, previous)
            found = replace(found, lacking=Lacking.of(model, switched, trial.slides))
            if reached is None or found.accuracy <= reached.accuracy:
                reached = found
            if found.accuracy <= ACCURACY:
                return replace(found, gradient=found.lacking.without(found.gradient))
            previous = found
    if reached is None:
        raise ComputationError(
            "there is no solution from the starts at these constants",
            where=f"the model {model.name}",
            remedy="other constants by `--set`, or `gbspec simulate`, which says where the solution ends",
        )
    return replace(reached, gradient=reached.lacking.without(reached.gradient))


def _equal_steps(model: Model) -> bool:
    """Whether steps are equal: those that follow a tolerance do not know the past."""
    return bool(model.delays)


def _trials(model: Model, trajectories: Trajectories, given: Given, method: Method) -> Iterator[tuple[Problem, _Trial]]:
    """Predictions by a method at one tolerance, or by equal steps of one size, after the other."""
    module = load_module(model, method)
    instance = module(dict(given.weights)) if model.networks else module.random(0)
    fixed = {k: v for k, v in given.weights.items() if k.endswith(("_center", "_scale"))}
    scale = np.where(np.abs(given.starts).max(axis=0) > 0, np.abs(given.starts).max(axis=0), 1.0)

    def posed(largest: float) -> Problem:
        packed = pack(trajectories, model, largest, method=method)
        scaling = scaling_of(model, packed, trajectories)
        return Problem(model, instance, packed, teacher_forcing(model, packed, 0.0), scaling)

    if _equal_steps(model):
        span = max(float(item.times[-1] - item.start) for item in trajectories.items)
        problems = (posed(span / parts if span > 0 else np.inf) for parts in PARTS)
    else:
        whole = posed(np.inf)
        problems = (replace(whole, control=Control(tolerance, scale)) for tolerance in TOLERANCES[method.name])
    for problem in problems:
        choice = choose(model, module, TrainOptions(), problem.packed.substeps, worthwhile=True)
        individuals = Individuals(problem, model, given.starts, fixed, choice)
        vector = [np.ravel(given.weights[name]) for name in individuals.parameters.weight_shapes]
        weights = np.concatenate([np.zeros(0), *vector])
        theta = individuals.vector(given.constants, weights)
        moments = individuals.engine.moments(theta, individuals.engine.plan(theta))
        with np.errstate(all="ignore"):
            found = individuals.first(given.constants, weights)
        events = happened(individuals.engine, theta) if model.switches else None
        slides = events is not None and bool(events.uncut.any())
        yield problem, _Trial(found.mean, found.constants, slides)
        scale = _sizes(moments.before, moments.initial, scale)


def _judged(
    model: Model, problem: Problem, trial: _Trial, given: Given, method: Method, previous: Evaluated | None
) -> Evaluated:
    """The objective from predictions, compared with that of the tolerance before."""
    density = Density(model, Measured.of(problem), given.noise)
    measured = density.measured
    constants = given.constants[measured.owner]
    nllh, by_mean, by_constants = density.slopes(trial.mean, constants)
    with np.errstate(invalid="ignore"):  # what does not move a prediction moves nothing by it, also a root at 0
        moved = np.where(trial.by_constants == 0, 0.0, by_mean[:, None] * trial.by_constants)
    gradient = (moved + by_constants).sum(axis=0)
    residual, sd = (x.numpy() for x in density.standardised(torch.from_numpy(trial.mean), torch.from_numpy(constants)))
    values = _values(model, problem, measured, trial.mean, sd, residual)
    found = Evaluated(
        nllh,
        float(np.sum(residual**2)),
        {k.name: float(g) for k, g in zip(model.learnables, gradient, strict=True)},
        values,
        np.inf,
        method.name,
    )
    if previous is None:
        return found
    # The root of the information of each constant: entries of the gradient are of this size where the model is right.
    known = np.sqrt(np.sum((trial.by_constants / np.where(sd > 0, sd, np.inf)[:, None]) ** 2, axis=0))
    typical = dict(zip(found.gradient, known.tolist(), strict=True))
    return replace(found, accuracy=change(previous, found, typical))


def _values(
    model: Model, problem: Problem, measured: Measured, mean: Array, sd: Array, residual: Array
) -> tuple[Value, ...]:
    """The measured values with their predictions, trajectory by trajectory in the order of time."""
    packed, row = problem.packed, np.nonzero(problem.seen)[0]
    measurement = as_measured(measured.value, measured.logarithm)
    signs = {-1: "<", 1: ">", 0: ""}
    return tuple(
        Value(
            packed.labels[measured.owner[i]],
            float(packed.row_time[row[i]]),
            model.channels[measured.channel[i]].name,
            float(mean[i]),
            float(measurement[i]),
            float(sd[i]),
            float(residual[i]),
            signs[int(measured.side[i])],
        )
        for i in ordered(measured.owner, packed.row_time[row], measured.channel)
    )


def ordered(owner: Integers, time: Array, channel: Integers) -> Integers:
    """The places of values, trajectory by trajectory in the order of time."""
    return np.lexsort((channel, time, owner))


def change(before: Evaluated, after: Evaluated, typical: Mapping[str, float] | None = None) -> float:
    """The largest change of the likelihood, a prediction or an entry of the gradient, relative to its size (of
    predictions: at least a hundredth of the largest one of the channel; of the gradient: of its largest entry, and at
    least the `typical` size of each: near a maximum all of them are small)."""
    parts = [abs(after.nllh - before.nllh) / max(abs(after.nllh), 1.0)]
    for channel in {one.channel for one in after.simulation}:
        pairs = [
            (a.value, b.value) for a, b in zip(after.simulation, before.simulation, strict=True) if a.channel == channel
        ]
        old, new = np.array([b for _, b in pairs]), np.array([a for a, _ in pairs])
        size = np.maximum(np.abs(new), 1e-2 * np.abs(new).max())
        parts.append(float(np.max(np.abs(new - old) / np.where(size > 0, size, 1.0))))
    largest, least = max(map(abs, after.gradient.values()), default=0.0), typical or {}
    for name, slope in after.gradient.items():
        parts.append(abs(slope - before.gradient[name]) / (max(largest, least.get(name, 0.0)) or 1.0))
    return float(np.max(parts))


def _sizes(before: Array, initial: Array, otherwise: Array) -> Array:
    """The largest size of each state [n] along a solution; `otherwise` where it is zero or not finite."""
    found = np.abs(np.concatenate([before, initial])).max(axis=0)
    return np.where(np.isfinite(found) & (found > 0), found, otherwise)
