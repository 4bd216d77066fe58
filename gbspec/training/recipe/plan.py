"""Which stages run, in which order. Decisions depend on the data and on results so far, never on the clock."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.training.engines.engine import Engine
from gbspec.training.engines.objective import residual_vector
from gbspec.training.optimise.adam import Adam
from gbspec.training.optimise.lbfgs_stage import LimitedMemory
from gbspec.training.optimise.levenberg_marquardt import LevenbergMarquardt, LevenbergOptions
from gbspec.training.optimise.stage import Stage
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.residuals import mean_loss, typical
from gbspec.training.recipe.breeding import Breeding
from gbspec.training.recipe.context import Context, released_starts
from gbspec.training.recipe.stages import STARTS_TOO, Choice, InitialStates, imputed_forcing
from gbspec.training.starts.search import Search

ITERATIONS: Mapping[str, Mapping[str, int]] = {
    "low": {
        "approach": 15,
        "imputed": 4,
        "teacher": 6,
        "half": 0,
        "blend": 4,
        "autoregressive": 8,
        "autoregressive, few data": 8,
        "least squares": 100,
        "adam": 100,
    },
    "normal": {
        "approach": 25,
        "imputed": 6,
        "teacher": 60,
        "half": 30,
        "blend": 4,
        "autoregressive": 14,
        "autoregressive, few data": 60,
        "least squares": 200,
        "adam": 300,
    },
    "high": {
        "approach": 60,
        "imputed": 10,
        "teacher": 200,
        "half": 100,
        "blend": 10,
        "autoregressive": 60,
        "autoregressive, few data": 120,
        "least squares": 500,
        "adam": 1500,
    },
}
"""Most iterations of each stage by effort."""
ENOUGH: Mapping[str, float] = {"low": 1e-6, "normal": 1e-9, "high": 1e-11}
"""Mean loss below which teacher forcing needs no further iteration (1e-9: residuals of 0.005 % of the deviations)."""
HALF_STEP = "half step"
"""The stage whose weights are those of half the largest step."""
STEADY = 1e-2
"""First damping where an earlier stage has come close already."""
LARGEST = 4 * 1024**3
"""Above this size of the Jacobian in bytes the second-order stages give way to Adam on minibatches of trajectories."""
PASSES = 128
"""Above this number of states, each a backward pass of a Jacobian (arrays), the networks are fitted by L-BFGS."""
NOISE = 0.01
"""Above this typical residual after teacher forcing (in deviations of the data) the data count as noisy."""
FEW = 600
"""Below this number of measured values the weights have a prior from the first."""
FIRST_RIDGE = 1e-3
"""The ridge before the data have set it, as a multiple of the squared typical residual (at least 1e-4)."""

Wanted = Callable[[Array], bool]
At = Callable[[int], Engine]


@dataclass(frozen=True)
class Planned:
    """A stage that may run: `make` builds it for the vector at its turn.

    Both others look at that vector too: `wanted`, whether the data ask for the stage, `possible`, whether there is
    anything for it to do.
    """

    name: str
    total: int
    make: Callable[[Array], Stage]
    wanted: Wanted
    possible: Wanted = lambda theta: True

    def due(self, theta: Array) -> bool:
        """Whether it runs."""
        return self.possible(theta) and self.wanted(theta)


def plan(context: Context, parameters: Parameters, marks: Mapping[str, Array]) -> list[Planned]:
    """The stages for these data and options, in order. `marks` will hold the vectors at the ends of earlier stages.

    Raises UserError (GB850) where a stage is asked for that such a model, such data or such options do not have.
    """
    stages = [stage for stage in _Planner(context, parameters, marks).stages() if stage.total > 0]
    named = context.options.named_stages
    missing = [name for name in named if name not in [stage.name for stage in stages]]
    if missing:
        there = ", ".join(f"`{stage.name}`" for stage in stages)
        message = f"`--stages`: with this model, data and options there is no stage `{missing[0]}`, only {there}"
        raise UserError([Diagnostic("GB850", message, None)])
    return [replace(stage, wanted=lambda theta: True) for stage in stages if stage.name in named] if named else stages


def step_fraction(begun: Collection[str]) -> float:
    """The fraction of the largest step at which the last of the stages that were begun fits."""
    return 0.5 if HALF_STEP in begun and not {"blend", "autoregressive"} & set(begun) else 1.0


class _Planner:
    def __init__(self, context: Context, parameters: Parameters, marks: Mapping[str, Array]) -> None:
        self.marks = marks
        self.context, self.parameters, self.options = context, parameters, context.options
        self.limits = ITERATIONS[context.options.effort]
        self.blend = context.options.blend
        self.values = int((context.packed().weights > 0).sum())
        self.enough = ENOUGH[context.options.effort]
        # Whole solutions of noisy data must not start from one noisy value each: the vector's layout stays the same.
        self.released = replace(parameters, start_free=released_starts(context.model, parameters.start_free))

    def stages(self) -> list[Planned]:
        return self._estimation() + ([self._breeding()] if self.options.initial == "bred" else [])

    def _estimation(self) -> list[Planned]:
        """The stages that estimate everything."""
        if self.options.method == "gradient-matching":
            return [self._starts("initial states", 1.0)]
        if self.options.method == "auto":
            return self._constants_alone() if not self.parameters.n_weights else self._automatic()
        return [self._starts("initial states", self.blend), self._chosen()]

    def _breeding(self) -> Planned:
        def make(theta: Array) -> Stage:
            # Starts matter throughout a noisy fit's whole solutions, and for the first rows under teacher forcing.
            blend = 0.0 if "autoregressive" in self.marks else self.blend
            return Breeding(self.context, self.released, blend)

        free = bool(self.parameters.start_free.any())
        return Planned(Breeding.name, 1, make, lambda theta: True, lambda theta: free)

    def _chosen(self) -> Planned:
        """The one optimiser that was asked for."""
        epochs = self.options.epochs
        if self.options.method == "adam":
            return self._adam(epochs or self.limits["adam"], lambda theta: True)
        if self.options.method == "lbfgs":
            return self._quasi_newton(epochs or self.limits["adam"])
        total = epochs or self.limits["teacher"]
        return self._newton("lm", total, self._at(self.blend), lambda theta: True, LevenbergOptions(tolerance=1e-6))

    def _constants_alone(self) -> list[Planned]:
        """A model whose functions are all known: least squares of the whole solution, from several starts."""
        blend = self.blend if self.options.forcing != "teacher" else 0.0
        plain = LevenbergOptions(robust=False, tolerance=1e-9, damping=1e-2)
        context, parameters = self.context, self.parameters

        def make(theta: Array) -> Stage:
            return Search(context.engine(parameters, blend), context.seed)

        def believed(theta: Array) -> bool:
            """Whether starts stand at single values of noisy data."""
            measured = not np.array_equal(self.released.start_free, parameters.start_free)
            return (
                measured and blend == 0.0 and typical(residual_vector(context.engine(parameters, 0.0), theta)) > NOISE
            )

        limit = self.limits["least squares"]
        return [
            Planned("search", 1, make, lambda theta: True),
            self._newton("least squares", limit, self._at(blend), lambda theta: True, plain),
            self._newton(STARTS_TOO, limit, self._at(0.0, 1.0, self.released), believed, plain),
        ]

    def _automatic(self) -> list[Planned]:
        """The recipe: see the module's documentation of the stages."""
        limits = self.limits
        if 8 * self.values * self.parameters.n_shared > LARGEST:
            return [self._starts("initial states", self.blend), self._adam(limits["adam"], lambda theta: True)]
        if len(self.context.model.states) > PASSES:
            return [self._starts("initial states", self.blend), self._quasi_newton(limits["adam"])]
        if self.options.forcing != "teacher":
            first, last = self._at(1.0), self._at(self.blend)
            return [
                self._starts("initial states", 1.0),
                self._newton("teacher forcing", limits["teacher"], first, lambda theta: True, self._prior),
                self._newton("forcing as asked", limits["autoregressive"], last, lambda theta: True, self._regular),
            ]
        whole = self._at(0.0, 1.0, self.released)
        return [
            self._adam(limits["approach"], self._hidden),
            self._newton("imputed forcing", limits["imputed"], self._imputed, self._needs_imputing, self._prior),
            self._starts("initial states", 1.0),
            self._newton("teacher forcing", self._teacher_limit(), self._at(1.0), lambda theta: True, self._prior),
            self._starts("initial states again", 1.0),
            self._newton(HALF_STEP, limits["half"], self._at(1.0, 0.5), self._clean, self._close),
            self._newton("blend", limits["blend"], self._at(0.3), self._noisy, self._regular),
            self._starts("initial states of whole solutions", 0.0, self._noisy, self.released),
            self._newton("autoregressive", self._whole_limit(), whole, self._noisy, self._regular),
            Planned("choice", 1, self._choice, lambda theta: True, self._both_fits),
        ]

    # ---------------------------------------------------------------- problems
    def _at(self, blend: float, fraction: float = 1.0, parameters: Parameters | None = None) -> At:
        layout = parameters or self.parameters
        return lambda iteration: self.context.engine(layout, blend, fraction, iteration)

    def _imputed(self, iteration: int) -> Engine:
        problem = self.context.problem(1.0, 1.0, iteration)
        problem = replace(problem, forcing=imputed_forcing(self.context, problem))
        return self.context.choice.engine(problem, self.parameters)

    # ---------------------------------------------------------------- decisions
    def _teacher_limit(self) -> int:
        """Few iterations where smooth curves already told of noise, under which teacher forcing is inconsistent."""
        limit = self.limits["teacher"]
        return min(limit, 4) if self.context.smooth else limit

    def _whole_limit(self) -> int:
        """With few data the ridge matters and comes to rest slowly; there an iteration costs little."""
        return self.limits["autoregressive, few data" if self.values < FEW else "autoregressive"]

    def _both_fits(self, theta: Array) -> bool:
        """Whether intervals and whole solutions were both fitted."""
        return {"teacher forcing", "autoregressive"} <= set(self.marks)

    def _hidden(self, theta: Array) -> bool:
        """Whether gradient matching could not reach the networks, so that they must be approached by small steps."""
        return not self.context.points.equations or not self.options.warm_start

    def _needs_imputing(self, theta: Array) -> bool:
        """Whether plain teacher forcing starts far worse than with every state imputed."""
        if not self.context.points.equations:
            return False
        plain = residual_vector(self.context.engine(self.parameters), theta)
        return typical(plain) > 3 * typical(residual_vector(self._imputed(0), theta)) + 1e-6

    def _noise(self, theta: Array) -> float:
        return typical(residual_vector(self.context.engine(self.parameters), theta))

    def _noisy(self, theta: Array) -> bool:
        return self._noise(theta) > NOISE

    def _clean(self, theta: Array) -> bool:
        return self.options.half_step and not self._noisy(theta)

    def _prior(self, theta: Array) -> LevenbergOptions:
        """Regularised where there are few data, else plain."""
        enough = self._above_step_error if self._half_step_follows() else self.enough
        return self._regular(theta) if self.values < FEW else LevenbergOptions(tolerance=0.02, enough=enough)

    def _half_step_follows(self) -> bool:
        named = self.options.named_stages
        return self.options.half_step and self.limits["half"] > 0 and (not named or HALF_STEP in named)

    def _close(self, theta: Array) -> LevenbergOptions:
        """As before, from where an earlier stage came to."""
        return replace(self._prior(theta), damping=STEADY, enough=self.enough)

    def _above_step_error(self, theta: Array, residuals: Array) -> float:
        """Mean loss that is enough at the whole step: what remains below the step's own error only fits that error."""
        half = residual_vector(self.context.engine(self.parameters, 1.0, 0.5), theta)
        return max(self.enough, mean_loss(half - residuals))

    def _regular(self, theta: Array) -> LevenbergOptions:
        """With a ridge on the weights, from the noise, or as asked for."""
        noise = max(self._noise(theta), 0.01)
        noise = noise if np.isfinite(noise) else 1.0
        if self.options.ridge is None:
            return LevenbergOptions(ridge=FIRST_RIDGE * noise**2, evidence=True, tolerance=1e-4)
        if self.options.ridge == 0:
            return LevenbergOptions(tolerance=1e-4)
        initial = np.concatenate([v.ravel() for k, v in self.context.module.weights.items() if k.endswith("weight")])
        deviation = self.options.ridge * float(np.sqrt(np.mean(initial**2)))
        return LevenbergOptions(ridge=noise**2 / deviation**2, tolerance=1e-4)

    # ---------------------------------------------------------------- stages
    def _choice(self, theta: Array) -> Stage:
        earlier = self.marks.get("initial states again", self.marks["teacher forcing"])
        context = self.context
        teacher, free = (context.engine(self.released, blend) for blend in (1.0, 0.0))
        return Choice(teacher, free, earlier, context.seed)

    def _starts(
        self, name: str, blend: float, wanted: Wanted = lambda theta: True, parameters: Parameters | None = None
    ) -> Planned:
        layout = parameters or self.parameters

        def make(theta: Array) -> Stage:
            return InitialStates(name, self.context.engine(layout, blend), self.context.seed)

        return Planned(name, 1, make, wanted, lambda theta: bool(layout.start_free.any()))

    def _adam(self, epochs: int, wanted: Wanted) -> Planned:
        def make(theta: Array) -> Stage:
            options = self.options
            return Adam("adam", epochs, self._at(self.blend), options, self.context.seed)

        return Planned("adam", epochs, make, wanted)

    def _quasi_newton(self, epochs: int) -> Planned:
        def make(theta: Array) -> Stage:
            return LimitedMemory("lbfgs", epochs, self._at(self.blend))

        return Planned("lbfgs", epochs, make, lambda theta: True)

    def _newton(
        self,
        name: str,
        total: int,
        engine_at: At,
        wanted: Wanted,
        options: LevenbergOptions | Callable[[Array], LevenbergOptions],
    ) -> Planned:
        def make(theta: Array) -> Stage:
            chosen = options if isinstance(options, LevenbergOptions) else options(theta)
            return LevenbergMarquardt(name, total, engine_at, chosen)

        return Planned(name, total, make, wanted)
