"""The marginal likelihood as one whose constants may exchange their roles (`other_maxima`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.ir import Learnable, Model
from gbspec.training.optimise import State, exchanged, exponents
from gbspec.training.population.layout import Layout
from gbspec.training.population.objective import Objective
from gbspec.training.population.stage import MarginalLikelihood, vector_of
from gbspec.training.problem import Bijections

LEAST_SPREAD = 1e-3
"""The least spread with which a fit begins after an exchange."""


def exchangeable(layout: Layout) -> dict[str, int]:
    """The places among the parameters u of the constants that all trajectories share, and of the medians of those with
    a distribution, by the names of the constants; spreads, correlations and sizes of noises play no such role."""
    model = layout.model
    spreads = {name for k in model.distributed if k.distribution for name, _ in k.distribution.spreads}
    others = spreads | _noises(model)
    return {name: place for name, place in layout.typical.items() if layout.each[place].name not in others}


def _noises(model: Model) -> set[str]:
    """The learnables in the sizes of noises that no right side and no channel contains."""
    values = [*model.balances, *(channel.value for channel in model.channels)]
    inside = {one.name for value in model.inlined(values) for one in value.free_symbols}
    made = [c.noise for c in model.channels if c.noise is not None]
    scales = [value for noise in made for value in (noise.value, noise.shape) if value is not None]
    return {one.name for value in scales for one in value.free_symbols} - inside


class Exchanged:
    """The constants of `exchangeable`; `finer` makes the objective at half the step."""

    def __init__(self, fit: MarginalLikelihood, finer: Callable[[], Objective]) -> None:
        self.fit, self._half = fit, finer
        layout = fit.layout
        found = exchangeable(layout)
        self.names, self._places = list(found), np.array(list(found.values()), dtype=np.int64)
        each = [layout.each[i] for i in self._places]
        self.maps, self.declared = Bijections.of(tuple(each)), np.array([k.start for k in each], dtype=np.float64)
        self.count = max(int(fit.objective.marginal.predictions.problem.seen.sum()), 1)
        self.units = exponents([k for k in layout.model.learnables if k.name in found])
        effects = [k.name for k in layout.distributed]
        # By columns, the effects of constants that are lognormal between trajectories alone, and the places in u of
        # their spreads.
        self._lognormal = {
            i: (effects.index(name), layout.names[spread])
            for i, name in enumerate(found)
            if name in effects and (spread := _spread(layout.distributed[effects.index(name)])) in layout.names
        }

    def at(self, theta: Array) -> State:
        """The state of the fit at a vector at which it has come to rest, with the modes there."""
        state = self.fit.going_on(theta)
        weights, u = self._parts(theta)
        return state | {"z": self.fit.whole.at(weights, u, state["z"], 0.0).z}

    def values(self, state: State) -> Array:
        """The constants [k] of a state."""
        u = state["theta"][self.fit.layout.slice()][self._places]
        return np.asarray(self.maps.to_natural(torch.from_numpy(u)).numpy())

    def moved(self, state: State, matrix: Array) -> State:
        """The state from which the fit begins after an exchange. Lognormal constants of single trajectories are
        exchanged too, and have the spreads that follow."""
        fit, layout, groups = self.fit, self.fit.layout, self.fit.likelihood.groups
        weights, u = self._parts(state["theta"])
        natural = layout.bijections.to_natural(torch.from_numpy(u)).numpy().copy()
        before = natural[self._places]
        natural[self._places] = after = exchanged(before, matrix)
        with torch.no_grad():
            rows, modes = fit.whole.marginal.rows(u), torch.from_numpy(state["z"])
            table = fit.likelihood.individual(layout.natural(rows), modes)[0].numpy()
            numbers = groups.numbers(modes).numpy().copy()
        each = np.tile(before, (len(table), 1))
        for i, (effect, _) in self._lognormal.items():
            each[:, i] = table[:, layout.place[effect]]
        each = np.array([exchanged(row, matrix) for row in each])
        for i, (effect, place) in self._lognormal.items():
            if (matrix[i] != np.eye(len(matrix))[i]).any():
                deviations = np.log(each[:, i] / after[i])
                natural[place] = max(float(np.sqrt(np.mean(deviations**2))), LEAST_SPREAD)
                numbers[:, effect] = deviations / natural[place]
        z, u = groups.together(numbers), layout.bijections.from_natural(natural)
        return fit.going_on(vector_of(fit.parameters, fit.likelihood, weights, u, z)) | {"z": z}

    def glance(self, state: State) -> float:
        """-2 log density of the values with all constants at their medians: one solution of each trajectory. Where the
        median of one constant takes the role of another's, it is the same, whatever the distributions are."""
        likelihood, (weights, u) = self.fit.likelihood, self._parts(state["theta"])
        natural = self.fit.layout.natural(self.fit.whole.marginal.rows(u))
        z = torch.zeros_like(torch.from_numpy(state["z"]))
        return float(likelihood.joint(likelihood.plain(natural, z, weights), z).sum())

    def objective(self, state: State) -> float:
        """-2 log likelihood with what priors contribute; infinite where the model cannot be solved."""
        return self._at(self.fit.whole, state["theta"], state["z"])

    def finer(self, state: State) -> float:
        """The same at half the solver's step."""
        return self._at(self._half(), state["theta"], state["z"])

    def between(self, one: State, other: State) -> float:
        """The same half-way between two states."""
        return self._at(self.fit.whole, 0.5 * (one["theta"] + other["theta"]), one["z"])

    def _at(self, objective: Objective, theta: Array, z: Array) -> float:
        return objective.at(*self._parts(theta), z, 0.0).objective

    def _parts(self, theta: Array) -> tuple[Array, Array]:
        """The weights and the parameters u of a vector."""
        return theta[: self.fit.parameters.n_weights], theta[self.fit.layout.slice()]


def _spread(learnable: Learnable) -> str:
    """The name of the spread of a constant that is lognormal between trajectories alone; empty for others."""
    made = learnable.distribution
    return "" if made is None or made.kind != "lognormal" or made.levels else made.spread or ""
