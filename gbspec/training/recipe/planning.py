"""The choice and order of stages. Decisions depend on the data and on previous results, never on elapsed time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.optimise import Adam, LevenbergMarquardt, LevenbergOptions, LimitedMemory, Stage
from gbspec.training.problem import Parameters, mean_loss, typical
from gbspec.training.recipe import populations
from gbspec.training.recipe.breeding import Breeding
from gbspec.training.recipe.choosing import choice_of_fits
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.cutting import cut_steps
from gbspec.training.recipe.disturbed import disturbed_stage, other_maxima
from gbspec.training.recipe.finer import HALVINGS, NETWORK_HALVINGS, STEADY, LastFit, continuing, finer_step
from gbspec.training.recipe.further import Further
from gbspec.training.recipe.growing import ATTEMPTS, GrowingHorizons, other_weights
from gbspec.training.recipe.judging import FEW, Judged, unmeasured
from gbspec.training.recipe.known import SegmentsOfKnown, search_of_known, search_with_starts
from gbspec.training.recipe.other_start import other_starts
from gbspec.training.recipe.planned import (
    At,
    Decision,
    Planned,
    Reached,
    always,
    left_for_intervals,
    shortened,
    step_fraction,
)
from gbspec.training.recipe.segments import horizons
from gbspec.training.recipe.shorter import shorter_steps
from gbspec.training.recipe.stages import InitialStates, imputed_forcing
from gbspec.training.recipe.thresholds import PATIENCE as THRESHOLD_PATIENCE
from gbspec.training.recipe.thresholds import ThresholdSearch, learned_thresholds
from gbspec.training.recipe.weighing import REWEIGHTINGS, reweighed
from gbspec.training.recipe.whole import ENOUGH, ROUNDING, demanding, whole_of_exact_data
from gbspec.training.stages import Effort, StageName, most_iterations

LARGEST = 4 * 1024**3
"""Above this size of the Jacobian in bytes Adam on minibatches of trajectories replaces the second-order stages."""
PASSES = 128
"""Above this number of states (each needs a backward pass of the Jacobian) the networks are fitted by L-BFGS."""
WITH_FEW_DATA: Mapping[Effort, int] = {"low": 8, "normal": 60, "high": 120}
"""Largest numbers of iterations of `autoregressive` with few data."""
FIRST_RIDGE = 1e-3
"""The initial ridge, as a multiple of the squared typical residual (at least 1e-4)."""
SPREAD = 0.07
"""A fit under the evidence's ridge rests where iterations move predictions by less than this many of their standard
deviations; what moves them less only shrinks weights that the data leave open."""
BELIEVED = 1e-3
"""Measured starts of known forms count as exact up to this typical residual, in standard deviations of the data."""
ALONE: Mapping[Effort, int] = {"low": 100, "normal": 300, "high": 1500}
"""Largest numbers of epochs of Adam and iterations of L-BFGS if no other stage fits the networks."""


def plan(context: Context, parameters: Parameters) -> list[Planned]:
    """The stages for these data and options, in order.

    Raises UserError (GB850) if a requested stage does not exist for this model, these data and these options.
    """
    stages = [stage for stage in _Planner(context, parameters).stages() if stage.total > 0]
    named = context.options.named_stages
    missing = [name for name in named if name not in [stage.name for stage in stages]]
    if missing:
        there = ", ".join(f"`{stage.name}`" for stage in stages)
        message = f"`--stages`: with this model, data and options there is no stage `{missing[0]}`, only {there}"
        raise UserError([Diagnostic("GB850", message, None)])
    return [replace(stage, wanted=always) for stage in stages if stage.name in named] if named else stages


class _Planner:
    def __init__(self, context: Context, parameters: Parameters) -> None:
        self.context, self.parameters, self.options = context, parameters, context.options
        self.blend = context.options.blend
        self.values = int((context.packed().weights > 0).sum())
        # Effort high is never worse than normal: it does the same first, and then continues.
        first = context.options.method == "auto" and parameters.n_weights and not context.options.named_stages
        self.effort: Effort = "normal" if first and self.options.effort == "high" else self.options.effort
        self.enough = ENOUGH[self.effort]
        # Whole solutions of noisy data must not start from single noisy values; the vector's layout stays the same.
        self.released = context.released(parameters)
        self.judged = Judged(context, parameters, self.released, self.values)

    def stages(self) -> list[Planned]:
        return self._estimation() + ([self._breeding()] if self.options.initial == "bred" else [])

    def _estimation(self) -> list[Planned]:
        """The stages of the estimation, without breeding."""
        if self.context.model.marginal:
            return populations.stages(self.context, self.parameters, self._regular)
        if self.context.model.diffusions:
            given = self.context, self.parameters, self._most(StageName.INNOVATIONS)
            return [disturbed_stage(*given), other_maxima(*given)]
        if self.options.method == "gradient-matching":
            return [self._starts(StageName.STARTS, 1.0)]
        if self.options.method == "auto":
            return self._constants_alone() if not self.parameters.n_weights else self._automatic()
        return [self._starts(StageName.STARTS, self.blend), self._chosen()]

    def _breeding(self) -> Planned:
        def make(reached: Reached) -> Stage:
            # Initial states affect whole solutions of a noisy fit, and only the first rows under teacher forcing.
            blend = 0.0 if StageName.AUTOREGRESSIVE in reached.marks else self.blend
            return Breeding(self.context, self.released, blend)

        free = bool(self.parameters.start_free.any())
        return Planned(StageName.BREEDING, 1, make, possible=lambda reached: free)

    def _chosen(self) -> Planned:
        """The one requested optimiser."""
        epochs = self.options.epochs
        if self.options.method == "adam":
            return self._adam(epochs or ALONE[self.options.effort])
        if self.options.method == "lbfgs":
            return self._quasi_newton(epochs or ALONE[self.options.effort])
        name = StageName.LEVENBERG_MARQUARDT
        return self._newton(name, self._at(self.blend), LevenbergOptions(tolerance=1e-6, most=np.inf), total=epochs)

    def _constants_alone(self) -> list[Planned]:
        """The stages of a model whose functions are all known: least squares of whole solutions, from several
        points."""
        blend = self.blend if self.options.forcing != "teacher" else 0.0
        plain = LevenbergOptions(robust=False, tolerance=1e-9, damping=1e-2, kinks=True)
        context, parameters = self.context, self.parameters

        def believed(reached: Reached) -> bool:
            """Whether initial values are single measurements of noisy data."""
            measured = not np.array_equal(self.released.start_free, parameters.start_free)
            if segments.adopted(reached):
                return not segments.alone(reached)
            return (
                measured
                and blend == 0.0
                and typical(residual_vector(context.engine(parameters, 0.0), reached.theta)) > BELIEVED
            )

        segments = SegmentsOfKnown(context, self.released, self.judged.whole_astray, self.effort)

        def known(reached: Reached) -> LastFit | None:
            if segments.alone(reached):
                return None
            layout = self.released if StageName.LEAST_SQUARES_STARTS in reached.marks else self.parameters
            return LastFit(layout, blend, blend, lambda reached: plain, True)

        released = self._at(0.0, 1.0, self.released)
        return [
            search_of_known(context, parameters, blend),
            *([segments.planned()] if blend == 0.0 else []),
            self._newton(StageName.LEAST_SQUARES, self._at(blend), plain, segments.discarded),
            search_with_starts(context, self.released, parameters.start_free, believed),
            self._newton(StageName.LEAST_SQUARES_STARTS, released, plain, believed),
            cut_steps(context, known, self.effort),
            *(
                finer_step(context, number, known, self.effort)
                for number in range(1, HALVINGS[self.options.effort] + 1)
            ),
            *(
                self._weights(plain, lambda reached: blend == 0.0 and not segments.alone(reached))
                for _ in range(REWEIGHTINGS)
            ),
        ]

    def _weights(self, options: LevenbergOptions | Callable[[Reached], LevenbergOptions], fitted: Decision) -> Planned:
        """Continues whole solutions that were `fitted` with channels weighed by their noise."""

        def settings(reached: Reached) -> LevenbergOptions:
            chosen = options if isinstance(options, LevenbergOptions) else options(reached)
            return continuing(chosen, reached)

        return reweighed(self.context, self._most(StageName.WEIGHTS), self._layout, settings, fitted)

    def _last_of_networks(self, reached: Reached) -> LastFit | None:
        """The last fit of the weights: of whole solutions, or of intervals; None for a fit of segments."""
        marks = reached.marks
        if StageName.WHOLE in marks:
            return LastFit(self._layout_of_whole(reached), 0.0, 0.0, self._whole, self.values < FEW)
        if StageName.AS_ASKED in marks:
            return LastFit(self.parameters, self.blend, self.blend, self._last, True)
        if StageName.AUTOREGRESSIVE in marks:
            if left_for_intervals(marks) is None:
                return LastFit(self.released, 0.0, 0.0, self._last, True)
            return None if StageName.HORIZONS in marks else LastFit(self.released, 1.0, 1.0, self._prior, False)
        if StageName.TEACHER not in marks or StageName.HORIZONS in marks:
            return None
        return LastFit(self._layout(reached), 1.0, 0.0, self._close, self.values < FEW)

    def _automatic(self) -> list[Planned]:
        """The stages of the recipe for unknown functions: see docs/training.md."""
        if 8 * self.values * self.parameters.n_shared > LARGEST:
            return [self._starts(StageName.STARTS, self.blend), self._adam(ALONE[self.options.effort])]
        if len(self.context.model.states) > PASSES:
            return [self._starts(StageName.STARTS, self.blend), self._quasi_newton(ALONE[self.options.effort])]
        if self.options.forcing != "teacher":
            first, last = self._at(1.0), self._at(self.blend)
            return [
                self._starts(StageName.STARTS, 1.0),
                self._newton(StageName.TEACHER, first, self._prior),
                *shorter_steps(self.context, self.parameters, self.blend, always, self.effort),
                self._newton(StageName.AS_ASKED, last, self._last),
                *self._continued(),
            ]
        whole = self._at(0.0, 1.0, self.released)
        fit = self._newton(StageName.AUTOREGRESSIVE, whole, self._last, self.judged.unfollowed, self._whole_limit())
        return [
            self._adam(self._most(StageName.ADAM), self._hidden),
            self._thresholds(),
            self._newton(StageName.IMPUTED, lambda reached: self._imputed, self._prior, self._needs_imputing),
            self._starts(StageName.STARTS, 1.0),
            self._newton(StageName.TEACHER, self._at(1.0), self._prior, total=self._teacher_limit()),
            self._starts(StageName.STARTS_AGAIN, 1.0),
            self._growing(),
            self._newton(StageName.HALF_STEP, self._at(1.0, 0.5), self._close, self._clean),
            *shorter_steps(self.context, self.parameters, 0.3, self._blended, self.effort),
            self._newton(StageName.BLEND, self._at(0.3), self._regular, self._blended),
            *shorter_steps(self.context, self.released, 0.0, self._whole_next, self.effort),
            self._starts(StageName.WHOLE_STARTS, 0.0, self._whole_next, self.released),
            fit,
            *other_starts(self.context, self.released, fit, self._last, self._from_warm_start()),
            *(self._weights(self._last, self.judged.noisy_whole) for _ in range(REWEIGHTINGS)),
            Planned(
                StageName.CHOICE, 1, partial(choice_of_fits, self.context, self.released), possible=self._both_fits
            ),
            whole_of_exact_data(self.context, self._layout_of_whole, self.effort, self._whole, self.judged.exact),
            *self._continued(),
        ]

    def _continued(self) -> list[Planned]:
        """What follows the last fit of networks: finer steps, and at effort high further iterations and finer steps."""

        def finer(effort: Effort) -> list[Planned]:
            return [
                finer_step(self.context, n, self._last_of_networks, self.effort)
                for n in range(1, NETWORK_HALVINGS[effort] + 1)
            ]

        def make(reached: Reached) -> Stage:
            found = self._last_of_networks(reached)
            assert found is not None, "the stage is possible"
            chosen = replace(continuing(found.options(reached), reached), enough=ENOUGH["high"])
            layout, blend, fraction = found.layout, found.blend, step_fraction(reached.begun)
            at = partial(self.context.engine, layout, blend, fraction)
            return Further(LevenbergMarquardt(StageName.FURTHER, total, at, chosen))

        total = most_iterations(StageName.FURTHER, self.options.effort)
        further = Planned(StageName.FURTHER, total, make, possible=lambda r: self._last_of_networks(r) is not None)
        high = self.options.effort == "high"
        cut = cut_steps(self.context, self._last_of_networks, self.effort)
        return [cut, *finer(self.effort), *([further, *finer("high")] if high and self.effort != "high" else [])]

    # ---------------------------------------------------------------- problems
    def _at(self, blend: float, fraction: float = 1.0, parameters: Parameters | None = None) -> Callable[[Reached], At]:
        """The engines of a stage, by what has been reached before it: at `fraction` of the step that is stable."""
        layout, at = parameters or self.parameters, self.context.engine
        return lambda reached: lambda i: at(layout, blend, fraction * shortened(reached.begun), i)

    def _imputed(self, iteration: int) -> Engine:
        problem = self.context.problem(1.0, 1.0, iteration)
        problem = replace(problem, forcing=imputed_forcing(self.context, problem))
        return self.context.choice.engine(problem, self.parameters)

    # ---------------------------------------------------------------- decisions
    def _most(self, stage: StageName) -> int:
        return most_iterations(stage, self.effort)

    def _teacher_limit(self) -> int:
        """The limit of teacher forcing: few iterations if smoothing curves have shown noise, since it is inconsistent
        then."""
        limit = self._most(StageName.TEACHER)
        return min(limit, 4) if self.context.kind == "smooth" else limit

    def _whole_limit(self) -> int:
        """The limit of whole solutions, which most fits do not reach."""
        return WITH_FEW_DATA[self.effort] if self.values < FEW else self._most(StageName.AUTOREGRESSIVE)

    def _both_fits(self, reached: Reached) -> bool:
        """Whether intervals and whole solutions were both fitted."""
        return {StageName.TEACHER, StageName.AUTOREGRESSIVE} <= set(reached.marks)

    def _hidden(self, reached: Reached) -> bool:
        """Whether gradient matching could not determine the networks, so that small gradient steps must come first."""
        return not self.context.points.equations or not self.options.warm_start

    def _needs_imputing(self, reached: Reached) -> bool:
        """Whether the initial residuals of plain teacher forcing are far larger than with every state imputed."""
        if not self.context.points.equations:
            return False
        plain = residual_vector(self.context.engine(self.parameters), reached.theta)
        return typical(plain) > 3 * typical(residual_vector(self._imputed(0), reached.theta)) + 1e-6

    def _layout(self, reached: Reached) -> Parameters:
        """The layout of the last fit: with free initial states where whole solutions were fitted with these, or where
        a stage has moved measured ones (their entries are not zero), which no other layout represents."""
        fitted = {StageName.AUTOREGRESSIVE, StageName.LEAST_SQUARES_STARTS} & set(reached.marks)
        moved = reached.theta[(self.released.free > 0) & (self.parameters.free == 0)].any()
        return self.released if fitted or moved else self.parameters

    def _layout_of_whole(self, reached: Reached) -> Parameters:
        """The layout of whole solutions of exact data. Initial states are free where all states are measured: the last
        digits of measured ones would be made up for by the functions, which became worse (up to ninefold)."""
        return self._layout(reached) if demanding(self.context) else self.released

    def _clean(self, reached: Reached) -> bool:
        return self.options.half_step and StageName.HORIZONS not in reached.marks and not self.judged.noisy(reached)

    def _whole_next(self, reached: Reached) -> bool:
        """Whether whole solutions are fitted without segments before."""
        return StageName.HORIZONS not in reached.marks and self.judged.unfollowed(reached)

    def _blended(self, reached: Reached) -> bool:
        return StageName.HORIZONS not in reached.marks and self.judged.noisy(reached)

    def _prior(self, reached: Reached) -> LevenbergOptions:
        """Options of the first stage: regularised if there are few data, else plain."""
        enough = self._above_step_error if self._half_step_follows() else self.enough
        return self._regular(reached) if self.values < FEW else LevenbergOptions(tolerance=0.02, enough=enough)

    def _half_step_follows(self) -> bool:
        named = self.options.named_stages
        return (
            self.options.half_step
            and self._most(StageName.HALF_STEP) > 0
            and (not named or StageName.HALF_STEP in named)
        )

    def _close(self, reached: Reached) -> LevenbergOptions:
        """The same options, with the damping for a vector that an earlier stage has improved."""
        return replace(self._prior(reached), damping=STEADY, enough=self.enough)

    def _whole(self, reached: Reached) -> LevenbergOptions:
        """The same for whole solutions of exact data."""
        return replace(self._close(reached), enough=ROUNDING if demanding(self.context) else self.enough)

    def _above_step_error(self, theta: Array, residuals: Array) -> float:
        """The mean loss at which the whole step ends: a smaller loss would only fit the step's discretisation error."""
        half = residual_vector(self.context.engine(self.parameters, 1.0, 0.5), theta)
        return max(self.enough, mean_loss(half - residuals))

    def _regular(self, reached: Reached) -> LevenbergOptions:
        """Options with a ridge on the weights, derived from the noise or as requested."""
        noise = max(self.judged.noise(reached), 0.01)
        noise = noise if np.isfinite(noise) else 1.0
        if self.options.ridge is None:
            spread = 0.0 if unmeasured(self.context.model) else SPREAD
            return LevenbergOptions(ridge=FIRST_RIDGE * noise**2, evidence=True, tolerance=1e-4, spread=spread)
        if self.options.ridge == 0:
            return LevenbergOptions(tolerance=1e-4)
        initial = np.concatenate([v.ravel() for k, v in self.context.module.weights.items() if k.endswith("weight")])
        deviation = self.options.ridge * float(np.sqrt(np.mean(initial**2)))
        return LevenbergOptions(ridge=noise**2 / deviation**2, tolerance=1e-4)

    def _last(self, reached: Reached) -> LevenbergOptions:
        """The same for a fit that may be the last one."""
        return replace(self._regular(reached), most=np.inf)

    # ---------------------------------------------------------------- stages
    def _growing(self) -> Planned:
        """Segments of growing length, from the warm start and the present vector, both twice (the second time with
        large residuals limited), and from other random weights."""
        context, parts = self.context, len(horizons(self.context))
        most = ATTEMPTS[self.effort]

        def make(reached: Reached) -> Stage:
            begun = reached.marks.get(StageName.SEARCH, reached.marks.get(StageName.WARM_START, reached.theta))
            first = [begun, reached.theta]
            ordered = first if not context.points.equations else first[::-1]
            starts = [start for start in ordered for _ in range(2)]
            starts += [self._random(reached.theta, number) for number in range(1, most - len(starts) + 1)]
            return GrowingHorizons(context, self.released, starts[:most], self.effort)

        return Planned(StageName.HORIZONS, parts * most, make, self.judged.astray, lambda reached: parts > 0)

    def _random(self, theta: Array, number: int) -> Array:
        """The vector with other random weights."""
        return other_weights(self.context, self.parameters, theta, number)

    def _from_warm_start(self) -> int:
        """The most iterations of whole solutions from the warm start: none unless data are few."""
        return WITH_FEW_DATA[self.effort] if self.values < FEW and self.effort != "low" else 0

    def _starts(
        self, name: StageName, blend: float, wanted: Decision = always, parameters: Parameters | None = None
    ) -> Planned:
        layout = parameters or self.parameters

        def make(reached: Reached) -> Stage:
            # Whole solutions can depend so much on the step that initial states belong to one.
            fraction = step_fraction(reached.begun) if name is StageName.WHOLE_STARTS else 1.0
            return InitialStates(name.value, self.context.engine(layout, blend, fraction), self.context.seed)

        return Planned(name, 1, make, wanted, lambda reached: bool(layout.start_free.any() or layout.own))

    def _adam(self, epochs: int, wanted: Decision = always) -> Planned:
        def make(reached: Reached) -> Stage:
            return Adam(StageName.ADAM.value, epochs, self._at(self.blend)(reached), self.options, self.context.seed)

        return Planned(StageName.ADAM, epochs, make, wanted)

    def _thresholds(self) -> Planned:
        """The search for constants in the conditions of events, which no derivative tells where they do not happen."""
        learned = learned_thresholds(self.context.model)

        def make(reached: Reached) -> Stage:
            pieces = self.context.kind == "pieces"  # noisy rows beyond a threshold would never see its event
            engine = self._imputed(0) if pieces else self.context.engine(self.parameters, 1.0)
            return ThresholdSearch(engine, self.context.seed, self.effort, self._regular(reached), self._random)

        most = THRESHOLD_PATIENCE[self.effort].improved if learned else 0
        return Planned(StageName.SEARCH, most, make)

    def _quasi_newton(self, epochs: int) -> Planned:
        def make(reached: Reached) -> Stage:
            return LimitedMemory(StageName.LBFGS.value, epochs, self._at(self.blend)(reached))

        return Planned(StageName.LBFGS, epochs, make)

    def _newton(
        self,
        name: StageName,
        engine_at: Callable[[Reached], At],
        options: LevenbergOptions | Callable[[Reached], LevenbergOptions],
        wanted: Decision = always,
        total: int | None = None,
    ) -> Planned:
        most = self._most(name) if total is None else total

        def make(reached: Reached) -> Stage:
            chosen = options if isinstance(options, LevenbergOptions) else options(reached)
            return LevenbergMarquardt(name.value, most, engine_at(reached), chosen)

        return Planned(name, most, make, wanted)
