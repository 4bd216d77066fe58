"""Which stages run, in which order. Decisions depend on the data and on results so far, never on the clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gbspec.data.trajectories import Array
from gbspec.training.context import Context
from gbspec.training.newton import LevenbergMarquardt, LevenbergOptions
from gbspec.training.parameters import Parameters
from gbspec.training.problem import Problem
from gbspec.training.stages import InitialStates, Stage, WarmStart, imputed_forcing, mean_loss
from gbspec.training.unroll import solve

ITERATIONS: Mapping[str, Mapping[str, int]] = {
    "low": {"imputed forcing": 4, "teacher forcing": 6, "half step": 0, "autoregressive": 10, "least squares": 100},
    "normal": {"imputed forcing": 6, "teacher forcing": 12, "half step": 3, "autoregressive": 25, "least squares": 200},
    "high": {"imputed forcing": 10, "teacher forcing": 50, "half step": 12, "autoregressive": 60, "least squares": 500},
}
"""Most iterations of each stage by effort."""


@dataclass(frozen=True)
class Planned:
    """A stage that may run: `wanted` looks at the vector at its turn; `make` builds it."""

    name: str
    total: int
    make: Callable[[], Stage]
    wanted: Callable[[Array], bool]


def plan(context: Context, parameters: Parameters) -> list[Planned]:
    """The stages for these data and options, in order."""
    return _Planner(context, parameters).stages()


class _Planner:
    def __init__(self, context: Context, parameters: Parameters) -> None:
        self.context, self.parameters = context, parameters
        self.limits = dict(ITERATIONS[context.options.effort])

    def stages(self) -> list[Planned]:
        context, options = self.context, self.context.options
        out: list[Planned] = []
        if context.model.networks and options.warm_start and len(context.points):
            out.append(Planned("warm start", 1, lambda: WarmStart(context, self.parameters), _always))
        if options.method == "gradient-matching":
            return [*out, self._starts("initial states", 1.0)]
        if options.method == "auto":
            return out + self._automatic()
        return out

    def _automatic(self) -> list[Planned]:
        return [
            self._lm("imputed forcing", lambda i: self._imputed(i), self._needs_imputing),
            self._starts("initial states", 1.0),
            self._lm("teacher forcing", lambda i: self.context.problem(1.0, 1.0, i), _always),
            self._starts("initial states again", 1.0),
            self._lm(
                "half step",
                lambda i: self.context.problem(1.0, 0.5, i),
                lambda theta: self.context.options.half_step,
                damping=0.1,
            ),
        ]

    def _half_step(self, theta: Array) -> bool:
        return self.context.options.half_step

    def _imputed(self, iteration: int) -> Problem:
        problem = self.context.problem(1.0, 1.0, iteration)
        return replace(problem, forcing=imputed_forcing(self.context, problem))

    def _needs_imputing(self, theta: Array) -> bool:
        """Whether plain teacher forcing starts far worse than with every state imputed."""
        if not len(self.context.points):
            return False
        problem = self.context.problem()
        plain = solve(problem, self.parameters, theta)
        imputed = solve(replace(problem, forcing=imputed_forcing(self.context, problem)), self.parameters, theta)
        if not np.isfinite(plain).all():
            return True
        return float(np.median(np.abs(plain))) > 3 * float(np.median(np.abs(imputed))) + 1e-6

    def _starts(self, name: str, blend: float) -> Planned:
        def make() -> Stage:
            stage = InitialStates(self.context.problem(blend), self.parameters, self.context.seed)
            stage.name = name
            return stage

        return Planned(name, 1, make, lambda theta: bool(self.parameters.start_free.any()))

    def _lm(
        self, name: str, problem_at: Callable[[int], Problem], wanted: Callable[[Array], bool], damping: float = 1.0
    ) -> Planned:
        total = self.limits[name]

        def make() -> Stage:
            return LevenbergMarquardt(name, total, problem_at, self.parameters, LevenbergOptions(damping=damping))

        return Planned(name, total, make, lambda theta: total > 0 and wanted(theta))


def _always(theta: Array) -> bool:
    return True


def solution_loss(context: Context, parameters: Parameters, theta: Array, blend: float) -> float:
    """Mean of half squared residuals of the solution with forcing of strength `blend`."""
    return mean_loss(solve(context.problem(blend), parameters, theta))
