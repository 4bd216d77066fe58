"""Predictions of measured values, and their sensitivities to the distributed constants, with further derivatives.

Everything downstream needs predictions f and sensitivities S = df/dk as functions of the trajectories' constants (and
of the networks' weights) that can be differentiated once. Without networks both come from the engine of the larger
model (`sensitivity`): its Jacobian has the derivatives of f and S with respect to all constants. With networks they
come from the torch graph, in which S is a forward derivative, with one copy of each trajectory for each k. Where steps
end at switches of right-hand sides S jumps, and comes from the Jacobian of the model itself (`differenced`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.backends import load_module
from gbspec.ir import METHODS, Model, Range, logarithmic, symbol
from gbspec.training.engines import Choice, Engine, TorchEngine
from gbspec.training.population.differenced import Differenced
from gbspec.training.population.sensitivity import Extended, extended, repacked, widened
from gbspec.training.population.sweeps import Sweeps, covered
from gbspec.training.problem import STRETCH, Integers, Parameters, Path, Problem, Scaling, teacher_forcing


@dataclass(frozen=True)
class Measured:
    """The m measured values: trajectory `owner` and `channel` of each, the `value` (its logarithm under lognormal
    noise), the root `weight` of how many measurements it averages, `scatter`, the sum of their squared deviations from
    it (of logarithms: relative to it), and its own standard deviation `sd` (0: none).
    `side`: -1 and 1 where the value is a limit that the measured one lies below or above, else 0."""

    owner: Integers
    channel: Integers
    value: Array
    weight: Array
    scatter: Array
    sd: Array
    logarithm: Mask
    trajectories: int
    side: Array

    @property
    def more(self) -> Array:
        """How many more measurements than one each value averages [m]; none of a limit."""
        return np.where(self.side == 0, self.weight**2 - 1.0, 0.0)

    @classmethod
    def of(cls, problem: Problem) -> Measured:
        """The measured values of a problem, row by row; a table with lognormal noise has positive ones alone."""
        packed, model = problem.packed, problem.model
        row, channel = np.nonzero(problem.seen)
        value, logs = problem.measured[row, channel].copy(), logarithmic(model)[channel]
        sd = packed.sd[row, channel]
        unit = np.where(logs, value, 1.0)
        sd, scatter = np.where(np.isfinite(sd), sd, 0.0) / unit, packed.scatter[row, channel] / unit**2
        value[logs] = np.log(value[logs])
        weight = packed.weights[row, channel]
        side = packed.limits.side[row, channel].astype(np.float64)
        return cls(packed.row_trajectory[row], channel, value, weight, scatter, sd, logs, packed.trajectories, side)


@dataclass(frozen=True)
class First:
    """Predictions [m], their derivatives [m, K] by the constants of the own trajectory, and [m, W] by the weights."""

    mean: Array
    constants: Array
    weights: Array


def individual_model(model: Model) -> Model:
    """The model in which every constant is free for each trajectory."""
    free = tuple(
        replace(k, start=k.start or 1.0, range=Range(), prior=None, per_trajectory=True, distribution=None)
        for k in model.learnables
    )
    return replace(model, learnables=free, implied=(), correlated=())


class Individuals:
    """Predictions for given constants [N, K] of each trajectory, by an engine of a model (first derivatives)."""

    def __init__(self, problem: Problem, model: Model, start: Array, fixed: dict[str, Array], choice: Choice) -> None:
        shape = (problem.packed.trajectories, len(model.states))
        self.problem = problem = _unscaled(problem)
        value = np.broadcast_to(start, shape).copy()
        self.parameters = Parameters(individual_model(model), value, np.ones(shape[1]), np.zeros(shape), fixed)
        self.engine: Engine = choice.engine(problem, self.parameters)
        scales = [k.start for k in self.parameters.model.learnables]
        self.unit = STRETCH * np.abs(np.array(scales, dtype=np.float64))
        # The last constants at which all solutions were finite.
        self._safe: Array | None = None
        self._held: Path | None = None

    def vector(self, constants: Array, weights: Array) -> Array:
        """The engine's vector."""
        parameters = self.parameters
        blocks = np.zeros((parameters.trajectories, parameters.n_local))
        blocks[:, : len(self.unit)] = constants / self.unit
        return np.concatenate([weights, blocks.ravel()])

    def path(self, constants: Array, weights: Array) -> Path:
        """The steps that are taken."""
        return self.engine.plan(self.vector(constants, weights)) if self._held is None else self._held

    @contextmanager
    def holding(self, constants: Array, weights: Array) -> Iterator[None]:
        """Steps stay those that are taken at these constants."""
        self._held = self.path(constants, weights)
        try:
            yield
        finally:
            self._held = None

    def first(self, constants: Array, weights: Array, of_weights: bool = False) -> First:
        """Predictions and derivatives; NaN for the trajectories whose solution is not finite."""
        found = self._first(constants, weights, of_weights)
        packed = self.problem.packed
        if np.isfinite(found.constants).all():
            self._safe = constants.copy()
            return found
        owner = packed.row_trajectory[np.nonzero(self.problem.seen)[0]]
        bad = np.zeros(packed.trajectories, dtype=np.bool_)
        bad[owner[~np.isfinite(found.mean)]] = True
        if self._safe is None or not bad.any() or bad.all():
            return found
        # Derivatives are computed for all at once: a trajectory without a solution must not take them from others.
        rest = self._first(np.where(bad[:, None], self._safe, constants), weights, of_weights)
        lost = bad[owner]
        return First(
            np.where(lost, np.nan, rest.mean),
            np.where(lost[:, None], np.nan, rest.constants),
            np.where(lost[:, None], np.nan, rest.weights),
        )

    def _first(self, constants: Array, weights: Array, of_weights: bool) -> First:
        theta, count = self.vector(constants, weights), int(self.problem.seen.sum())
        path = self.path(constants, weights)
        moments = self.engine.moments(theta, path)
        mean = moments.mean[self.problem.seen]
        columns = self.parameters.n_weights if of_weights else 0
        if not moments.finite:
            return First(mean, np.full((count, len(self.unit)), np.nan), np.full((count, columns), np.nan))
        found = self.engine.jacobian(theta, path, moments, np.ones_like(moments.mean), not of_weights)
        local = found.local.numpy()[:, : len(self.unit)] / self.unit
        return First(mean, local, found.shared.numpy()[:, :columns])

    def mean(self, constants: Array, weights: Array) -> Array:
        """Predictions [m] alone."""
        theta = self.vector(constants, weights)
        return self.engine.moments(theta, self.path(constants, weights)).mean[self.problem.seen]

    def back(self, constants: Array, weights: Array, cotangent: Array) -> tuple[Array, Array]:
        """The products of `cotangent` [m] with the derivatives by the constants [N, K] and by the weights [W], in one
        pass forward and one back."""
        theta, table = self.vector(constants, weights), np.zeros(self.problem.seen.shape)
        table[self.problem.seen] = cotangent
        with torch.enable_grad():  # the caller may be a function of torch, which has switched it off
            found = self.engine.pullback(theta, self.path(constants, weights), table)
        local = found[self.parameters.n_shared :].reshape(self.parameters.trajectories, self.parameters.n_local)
        return local[:, : len(self.unit)] / self.unit, found[: self.parameters.n_weights]


class _Wider(Individuals):
    """Those of the larger model with sensitivities, on the steps of the model alone."""

    def __init__(self, of: Predictions, made: Extended, choice: Choice) -> None:
        self._of, self._made, self._times = of, made, 1 + len(of.distributed)
        self._taken: tuple[Path, Path] | None = None
        model, own = made.model, of.problem
        packed = repacked(own.packed, self._times, made.doses)
        module = load_module(model, METHODS[own.module.solver]).random(0)
        problem = Problem(model, module, packed, teacher_forcing(model, packed, 0.0), own.scaling)
        further = np.zeros((packed.trajectories, len(model.states) - len(own.model.states)))
        start = np.concatenate([of.parameters.start_value, further], 1)
        super().__init__(problem, model, start, {}, choice.of_model(model, type(module), self._times))

    def path(self, constants: Array, weights: Array) -> Path:
        """The steps of the model alone."""
        own = self._of.individuals.path(constants, weights)
        if self._taken is None or self._taken[0] is not own:
            self._taken = own, widened(own, self._times, self._made.doses)
        return self._taken[1]


def _unscaled(problem: Problem) -> Problem:
    """The problem whose residuals are plain differences: what is pulled back are predictions."""
    packed, channels = problem.packed, len(problem.model.channels)
    scaling = Scaling(np.zeros(channels, dtype=bool), np.ones_like(packed.values), np.ones(channels))
    limits = replace(packed.limits, side=np.zeros_like(packed.limits.side))
    return replace(problem, scaling=scaling, packed=replace(packed, limits=limits))


class Second(Protocol):
    """Predictions [m] and their sensitivities [m, q], differentiable in constants [N, K] and weights [W]."""

    def __call__(self, constants: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Both at these constants and weights."""


class Predictions:
    """All predictions for one problem: whole solutions, with given starts."""

    def __init__(self, problem: Problem, parameters: Parameters, choice: Choice, distributed: tuple[str, ...]) -> None:
        self.problem, self.parameters, self.choice = problem, parameters, choice
        self.distributed = distributed
        self.measured = Measured.of(problem)
        self.individuals = Individuals(problem, problem.model, parameters.start_value, dict(parameters.fixed), choice)

    def first(self, constants: Array, weights: Array) -> tuple[Array, Array]:
        """Predictions [m] and their sensitivities [m, q] to the distributed constants, at constants [N, K] and weights
        [W]; NaN for the trajectories whose solution is not finite."""
        if isinstance(self.second, _Sensitivities):
            return self.second.plain(constants, weights)
        found = self.individuals.first(constants, weights)
        return found.mean, found.constants[:, self._places]

    @cached_property
    def holdable(self) -> bool:
        """Whether a trajectory's steps can stay as they are when its constants move: no dose then arrives elsewhere."""
        by = [symbol(name) for name in self.distributed]
        return not any(dose.lag.has(k) for dose in self.problem.model.doses for k in by)

    @cached_property
    def order(self) -> Integers:
        """The measured values trajectory by trajectory, in the order of time [m]."""
        row, channel = np.nonzero(self.problem.seen)
        return np.lexsort((channel, self.problem.packed.row_index[row], self.measured.owner))

    def copies(self, count: int) -> Predictions:
        """Those for `count` copies of all trajectories, one after the other."""
        index = np.tile(np.arange(self.problem.packed.trajectories), count)
        return Predictions(self.problem.take(index), self.parameters.take(index), self.choice, self.distributed)

    @cached_property
    def second(self) -> Second:
        """The predictions with second derivatives."""
        if not self.distributed:
            return _Linear(self)
        if self.problem.model.switches:
            return self._differenced()
        made = extended(self.problem.model, self.distributed)
        if made is None:
            return self._swept()
        return _Sensitivities(self, _Wider(self, made, self.choice))

    def _differenced(self) -> Second:
        """Where steps end at switches of right-hand sides, where sensitivities jump."""
        individuals = self.individuals

        def jacobian(constants: Array, weights: Array) -> tuple[Array, Array, Array]:
            found = individuals.first(constants, weights, of_weights=True)
            return found.mean, found.constants, found.weights

        return Differenced(jacobian, np.array(self._places), self.measured.owner, individuals.unit / STRETCH)

    @property
    def _places(self) -> list[int]:
        """The places of the distributed constants among all learnables [q]."""
        names = [k.name for k in self.problem.model.learnables]
        return [names.index(name) for name in self.distributed]

    def _swept(self) -> Second:
        """With networks: by sweeps of casadi, or by torch where these do not cover the problem."""
        if covered(self.problem):
            return Sweeps(self.problem, self.parameters, self.distributed)
        return _Graph(self)


def _moved(first: Tensor, slopes: Tensor, constants: Tensor, at: Tensor, owner: Tensor) -> Tensor:
    """Values expanded to first order in the constants of their trajectories around `at`."""
    return first + torch.einsum("m...k,mk->m...", slopes, (constants - at)[owner])


class _Linear:
    """Without distributed constants: predictions alone."""

    def __init__(self, of: Predictions) -> None:
        self.of = of

    def __call__(self, constants: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Predictions to first order; without sensitivities."""
        at = constants.detach()
        found = self.of.individuals.first(at.numpy(), weights.detach().numpy(), of_weights=True)
        owner = torch.from_numpy(self.of.measured.owner)
        mean = _moved(torch.from_numpy(found.mean), torch.from_numpy(found.constants), constants, at, owner)
        mean = mean + torch.from_numpy(found.weights) @ (weights - weights.detach())
        return mean, mean.new_zeros((len(mean), 0))


class _Sensitivities:
    """By the engine of the larger model; the result is expanded to first order in the constants."""

    def __init__(self, of: Predictions, individuals: Individuals) -> None:
        self.of, self.individuals = of, individuals
        channels, times = len(of.problem.model.channels), 1 + len(of.distributed)
        number = np.full(individuals.problem.seen.shape, -1, dtype=np.int64)
        number[individuals.problem.seen] = np.arange(int(individuals.problem.seen.sum()))
        row, channel = np.nonzero(of.problem.seen)
        self.place = np.stack([number[row, channel + i * channels] for i in range(times)], 1)

    def plain(self, constants: Array, weights: Array) -> tuple[Array, Array]:
        """Predictions and sensitivities, without derivatives: one solution of the larger model."""
        found = self.individuals.mean(constants, weights)[self.place]
        return found[:, 0], found[:, 1:]

    def __call__(self, constants: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Predictions and sensitivities."""
        at = constants.detach()
        found = self.individuals.first(at.numpy(), weights.detach().numpy())
        value, slope = torch.from_numpy(found.mean[self.place]), torch.from_numpy(found.constants[self.place])
        owner = torch.from_numpy(self.of.measured.owner)
        both = _moved(value, slope, constants, at, owner)
        return both[:, 0], both[:, 1:]


class _Graph:
    """By the torch graph: one copy of every trajectory for each distributed constant, with its forward derivative."""

    def __init__(self, of: Predictions) -> None:
        self.of = of
        count, copies = of.problem.packed.trajectories, len(of.distributed)
        index = np.tile(np.arange(count), copies)
        problem = of.problem.take(index) if copies > 1 else of.problem
        parameters = of.individuals.parameters.take(index)
        self.engine, self.index = TorchEngine(problem, parameters), torch.from_numpy(index)
        names = [k.name for k in of.problem.model.learnables]
        self.tangent = torch.zeros((len(index), len(names)), dtype=torch.float64)
        for k, name in enumerate(of.distributed):
            self.tangent[k * count : (k + 1) * count, names.index(name)] = 1.0
        row, self.channel = np.nonzero(of.problem.seen)
        packed, table = of.problem.packed, problem.packed.row_table
        owner, place = packed.row_trajectory[row], packed.row_index[row]
        self.row = np.stack([table[owner + k * count, place] for k in range(copies)], 1)

    def __call__(self, constants: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Predictions and sensitivities."""
        parameters, unit = self.engine.parameters, torch.from_numpy(self.of.individuals.unit)
        with torch.no_grad():
            theta = self._vector(constants[self.index], weights, unit, parameters).numpy()
            path = self.engine.plan(theta)
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(constants[self.index], self.tangent)  # type: ignore[no-untyped-call]  # torch does not annotate it
            mean = self.engine.unroll(self._vector(dual, weights, unit, parameters), path, whole=True).mean
            primal, tangent = forward_ad.unpack_dual(mean)  # type: ignore[no-untyped-call]  # torch does not annotate it
        tangent = torch.zeros_like(primal) if tangent is None else tangent
        return primal[self.row[:, 0], self.channel], tangent[self.row, self.channel[:, None]]

    @staticmethod
    def _vector(constants: Tensor, weights: Tensor, unit: Tensor, parameters: Parameters) -> Tensor:
        start = constants.new_zeros((len(constants), parameters.n_local - len(unit)))
        return torch.cat([weights, torch.cat([constants / unit, start], 1).reshape(-1)])
