"""The start of a population fit: all trajectories with the same constants, by the stages of models without populations.

The pooled model has the medians in place of the constants, 0 in place of effects, and no spreads; its least squares
give the medians and the weights from which the marginal likelihood is maximised, and its residuals the first noises.
Effects that are arguments of networks are estimated for each trajectory, with a standard normal prior: where a network
does not depend on its effect, the marginal likelihood has by symmetry no slope along that dependence, and would never
find it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import sympy
import torch
from sympy.core.function import AppliedUndef

from gbspec.arrays import Array
from gbspec.ir import Learnable, Model, Prior, Range, counted_channels
from gbspec.training.engines import Engine, predicted
from gbspec.training.optimise import Outcome, Stage, State
from gbspec.training.population.counts import likeliest_size
from gbspec.training.population.layout import Layout
from gbspec.training.problem import Bijection, Parameters, residuals_of

INNER = "inner."
NOTHING = 1e-9
"""The pooled value of an effect lies within this of 0."""
FAR = 4.0
"""The effects of single trajectories, arguments of networks, lie within this of 0."""
INSIDE = 1e-6
"""The marginal likelihood begins at least so far inside of bounds, as a share of their range."""
OF_RESIDUALS = 0.7
"""The first noise, as a part of the root mean square residual of the pooled fit, which contains the spreads too."""


def pooled_model(model: Model) -> Model:
    """The model in which all trajectories have the same constants."""
    inside = _in_arguments(model)
    return replace(
        model, learnables=tuple(_pooled(k, k.symbol in inside) for k in model.learnables), implied=(), correlated=()
    )


def _in_arguments(model: Model) -> set[sympy.Basic]:
    """The symbols in the arguments of unknown functions."""
    values = [*model.balances, *(channel.value for channel in model.channels), *(e.residual for e in model.constraints)]
    calls = {call for value in model.inlined(values) for call in value.atoms(AppliedUndef)}
    return {symbol for call in calls for argument in call.args for symbol in argument.free_symbols}


def _pooled(learnable: Learnable, argument: bool) -> Learnable:
    if learnable.distribution is None:
        return learnable
    if learnable.distribution.kind == "standard" and argument:
        prior = Prior("normal", 0.0, 1.0)
        return replace(learnable, distribution=None, range=Range(-FAR, FAR), prior=prior)
    if learnable.distribution.kind == "standard":
        prior, bounds = Prior("normal", 0.0, NOTHING), Range(-NOTHING, NOTHING)
        return replace(learnable, per_trajectory=False, distribution=None, range=bounds, prior=prior)
    return replace(learnable, per_trajectory=False, distribution=None)


def pooled_parameters(parameters: Parameters, theta: Array | None = None) -> Parameters:
    """The layout of the pooled model's vector; with a population's vector `theta`, all constants that trajectories
    share are held at their values there."""
    model = pooled_model(parameters.model)
    if theta is None:
        return replace(parameters, model=model)
    with torch.no_grad():
        table = parameters.constants(torch.from_numpy(theta)).numpy()[:, len(parameters.model.constants) :]
    values = dict(zip((k.name for k in model.learnables), map(float, np.median(table, axis=0)), strict=True))
    held = tuple(k if k.per_trajectory else _held(k, values[k.name]) for k in model.learnables)
    return replace(parameters, model=replace(model, learnables=held))


def _held(learnable: Learnable, value: float) -> Learnable:
    """A constant that stays within `NOTHING` of a value."""
    width = NOTHING * (abs(value) or 1.0)
    return replace(learnable, range=Range(value - width, value + width), start=value, prior=None)


def pooled_vector(whole: Parameters, own: Parameters, theta: Array) -> Array:
    """The vector of the layout `own` of a pooled model for a population's one: medians over the trajectories."""
    with torch.no_grad():
        table = whole.constants(torch.from_numpy(theta)).numpy()[:, len(whole.model.constants) :]
    values = np.median(table, axis=0)
    medians = whole.medians(theta)
    for i, learnable in enumerate(whole.model.learnables):
        if learnable.distribution is not None:
            values[i] = np.clip(values[i], own.model.learnables[i].range.low, own.model.learnables[i].range.high)
            values[i] = values[i] if learnable.distribution.median else medians[learnable.name]
    weights = {name: value.numpy() for name, value in whole.weights(torch.from_numpy(theta)).items()}
    return own.vector(weights, values)


class Pooled:
    """A stage of the pooled model as one of the population: its vector is `engine.parameters`' own.

    It begins where the stage before has ended, or at `start`.
    """

    def __init__(self, stage: Stage, engine: Engine, parameters: Parameters, start: Array | None = None) -> None:
        self.stage, self.engine, self.parameters, self.start = stage, engine, parameters, start
        self.name, self.total = stage.name, stage.total
        self.layout = Layout(parameters)

    def begin(self, theta: Array) -> State:
        """The state of the inner stage."""
        first = theta if self.start is None else self.start
        return self._whole(self.stage.begin(self.vector(first)), first)

    def step(self, state: State, iteration: int) -> Outcome:
        """One step of the inner stage."""
        outcome = self.stage.step(self.inner(state), iteration)
        note = outcome.note
        if note and self.parameters.model.distributed:
            note = f"by least squares with the same constants for all trajectories, where this fit began, {note}"
        return replace(outcome, state=self._whole(outcome.state, state["theta"]), note=note)

    def inner(self, state: State) -> State:
        """The state of the inner stage."""
        return {name.removeprefix(INNER): value for name, value in state.items() if name.startswith(INNER)}

    def _whole(self, inner: State, theta: Array) -> State:
        return {f"{INNER}{name}": value for name, value in inner.items()} | {"theta": self.theta(inner["theta"], theta)}

    def vector(self, theta: Array) -> Array:
        """The pooled vector for a population's one."""
        return pooled_vector(self.parameters, self.engine.parameters, theta)

    def theta(self, pooled: Array, before: Array) -> Array:
        """The population's vector: medians and individuals at the pooled values, noises from the residuals."""
        whole, own = self.parameters, self.engine.parameters
        out = before.copy()
        out[: whole.n_weights] = pooled[: whole.n_weights]
        with torch.no_grad():
            each = own.constants(torch.from_numpy(pooled)).numpy()[:, len(whole.model.constants) :]
        values = each[0]
        known = dict(zip((k.name for k in whole.model.learnables), values, strict=True))
        noises = self._noises(pooled)
        first = {k.name: k.start for k in self.layout.each}
        for learnable in self.layout.each:
            if learnable.name in known and learnable.name not in noises:
                first[learnable.name] = known[learnable.name]
        first |= noises
        for learnable in whole.model.distributed:
            made = learnable.distribution
            if made is None or not made.median:
                continue
            first[made.median] = known[learnable.name]
            if made.kind == "normal" and made.spread is not None and made.spread not in known:
                first[made.spread] = 0.3 * abs(known[learnable.name]) or first[made.spread]
        natural = np.array([Bijection.of(k).inside(first[k.name], INSIDE) for k in self.layout.each])
        out[self.layout.slice()] = self.layout.bijections.from_natural(natural)
        if whole.own:
            local = out[whole.n_shared :].reshape(whole.trajectories, whole.n_local)
            local[:, : len(whole.own)] = whole.bijections(whole.own).from_natural(each[:, list(whole.own)].copy())
        return out

    def _noises(self, pooled: Array) -> dict[str, float]:
        """First values of noises, and of sizes of counts, that are one learned number, from the predictions of the
        pooled fit."""
        model, problem = self.parameters.model, self.engine.problem
        predictions = predicted(self.engine, pooled).mean
        residuals = residuals_of(problem, predictions)
        names = {k.name for k in self.layout.each}
        found = self._sizes(predictions, names)
        for i, channel in enumerate(model.channels):
            value = channel.noise.value if channel.noise is not None else None
            rows = problem.valued[:, i]
            if value is None or not value.is_Symbol or value.name not in names or not rows.any():
                continue
            size = float(np.sqrt(np.mean(residuals[rows, i] ** 2))) * float(problem.scaling.channel[i])
            if np.isfinite(size) and size > 0:
                found[value.name] = OF_RESIDUALS * size
        return found

    def _sizes(self, predictions: Array, names: set[str]) -> dict[str, float]:
        """The likeliest sizes of counts with the expectations `predictions` [R, C], of all channels that share one."""
        model, problem, found = self.parameters.model, self.engine.problem, dict[str, float]()
        shapes = [channel.noise.shape if channel.noise is not None else None for channel in model.channels]
        of_counts = [shape.name if shape is not None and shape.is_Symbol else "" for shape in shapes]
        for name in names & {name for name, one in zip(of_counts, counted_channels(model), strict=True) if one}:
            rows = problem.valued & np.array([one == name for one in of_counts])
            if rows.any():
                number = problem.packed.weights[rows] ** 2
                found[name] = likeliest_size(problem.packed.values[rows], predictions[rows], number)
        return found
