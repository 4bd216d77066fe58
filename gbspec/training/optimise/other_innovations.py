"""The likelihood of innovations as one whose constants may exchange their roles (`other_maxima`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.engines import FilterEngine
from gbspec.training.optimise.exchanges import exchanged
from gbspec.training.optimise.innovations import InnovationsFit
from gbspec.training.optimise.priors import Priors
from gbspec.training.optimise.restricted import sizes
from gbspec.training.optimise.stage import State
from gbspec.training.optimise.units import exponents
from gbspec.training.problem import Bijections


class OtherInnovations:
    """The constants that trajectories share and that are no sizes of disturbances or noises. `vector` gives that of
    the likelihood for a trainable vector, and `finer` makes the filter with half the step."""

    def __init__(
        self, fit: InnovationsFit, vector: Callable[[Array], Array], finer: Callable[[], FilterEngine]
    ) -> None:
        self.fit, self._vector, self._half = fit, vector, finer
        parameters, engine = fit.engine.parameters, fit.engine
        held = set(sizes(engine).tolist())
        chosen = [i for i, _ in enumerate(parameters.shared) if parameters.n_weights + i not in held]
        learnables = [parameters.model.learnables[parameters.shared[i]] for i in chosen]
        self._places = np.array([parameters.n_weights + i for i in chosen], dtype=np.int64)
        self.names, self.maps = [one.name for one in learnables], Bijections.of(tuple(learnables))
        self.declared = np.array([one.start for one in learnables], dtype=np.float64)
        self.units = exponents(learnables)
        self.count = max(int(engine.problem.seen.sum()), 1)

    def at(self, theta: Array) -> State:
        """The state of the fit at a vector at which it has come to rest."""
        return self.fit.going_on(self._vector(theta))

    def values(self, state: State) -> Array:
        """The constants [k] of a state."""
        return np.asarray(self.maps.to_natural(torch.from_numpy(state["theta"][self._places])).numpy())

    def moved(self, state: State, matrix: Array) -> State:
        """The state from which the fit begins after an exchange."""
        vector = self._of(state).copy()
        vector[self._places] = self.maps.from_natural(exchanged(self.values(state), matrix))
        return self.fit.going_on(vector)

    def glance(self, state: State) -> float:
        """The objective."""
        return self.objective(state)

    def objective(self, state: State) -> float:
        """-2 log likelihood with what priors contribute; infinite where the model cannot be solved."""
        return self._at(self.fit.engine, self._of(state))

    def finer(self, state: State) -> float:
        """The same at half the solver's step; a linear model is solved exactly."""
        engine = self.fit.engine if self.fit.engine.exact is not None else self._half()
        return self._at(engine, self._of(state))

    def between(self, one: State, other: State) -> float:
        """The same half-way between two states."""
        return self._at(self.fit.engine, 0.5 * (self._of(one) + self._of(other)))

    def _of(self, state: State) -> Array:
        return np.concatenate([state["theta"], state["log_sd"]])

    def _at(self, engine: FilterEngine, vector: Array) -> float:
        priors = Priors.of_likelihood(engine.problem, engine.parameters)
        return 2 * (engine.value(vector) + priors.penalty(engine.layout.split(vector)[0]))
