"""Whether the solver's step is short enough for a fit: whether half of it would move a solution or a constant."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import FLAT
from gbspec.diagnostics import ComputationError
from gbspec.runs import DEPENDS
from gbspec.training.engines import Engine, predicted, residual_table, residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, Stage, State, moved
from gbspec.training.problem import Parameters, mean_loss, measured_only
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.growing import GrowingHorizons
from gbspec.training.recipe.planned import Planned, Reached, step_fraction
from gbspec.training.recipe.stiffness import LIMIT, NEAR, times_step
from gbspec.training.stages import Effort, StageName, most_iterations
from gbspec.training.starts import refit_starts

HALVINGS: Mapping[Effort, int] = {"low": 3, "normal": 6, "high": 8}
"""How often the step may be halved where all forms are known."""
NETWORK_HALVINGS: Mapping[Effort, int] = {"low": 2, "normal": 4, "high": 6}
"""How often it may be halved with networks, whose fits take longer."""
STEADY = 1e-2
"""Initial damping if an earlier stage has already come close to the minimum."""
APART = 10.0
"""Solutions that are this many standard deviations of a channel's data outside of their range are astray."""
SHOWS, LEAST_ERROR = 0.1, 1e-5
"""A step's error shows where it moves a solution by more than this share of the noise, or a constant by more than this
many of its standard deviations, and where it is larger than this fraction of a channel's scale."""


@dataclass(frozen=True)
class LastFit:
    """The fit that is continued: layout of the vector, strength of teacher forcing and options.

    `seen` is the strength with which the step's error is looked at; `constants`: whether constants have intervals.
    """

    layout: Parameters
    blend: float
    seen: float
    options: Callable[[Reached], LevenbergOptions]
    constants: bool


def continuing(options: LevenbergOptions, reached: Reached) -> LevenbergOptions:
    """The options of a stage that continues a fit: with little damping, and the ridge where its evidence stood.

    Without a ridge the damping that the fit ended with is little enough. Each damping that is tried on the way from a
    larger one costs as much as an iteration at rest does: of exact data the last stage took twice as long.
    """
    if options.ridge == 0:
        return replace(options, damping=min(reached.damping, STEADY) or STEADY)
    ridge = reached.ridge if options.evidence and reached.ridge > 0 else options.ridge
    return replace(options, damping=STEADY, ridge=ridge)


HELPS = 0.25
"""The step is halved for states where that divides its error by at least four; smooth solutions of `rk4` by sixteen."""
INEXACT, LIMITED, STATES = "inexact", "limited", "states"
"""Reasons for a finer step: its error shows in what is measured or in a constant, solutions are near its limit of
stability, or its error shows in states."""
LEAST_ADAPTIVE = 1e-8
"""The same fraction for adaptive steps, which cost little more at a smaller tolerance."""


def step_shows(now: Engine, half: Engine, theta: Array, constants: bool, least: float = LEAST_ERROR) -> bool:
    """Whether halving the step changes solutions by more than a share of the noise, or, with `constants`, moves a
    constant.

    A change d of the residuals moves a constant by at most |d| / sigma of its standard deviations (the length of the
    projection of d on one direction, in units of the noise). With networks most of a change is in other directions
    than that of a constant; where this bound is not kept, a Gauss-Newton step tells how far the constants move.
    """
    parameters, seen = now.parameters, now.problem.seen
    before, after = residual_table(now, theta), residual_table(half, theta)
    suspect = False
    for i in range(before.shape[1]):
        rows = seen[:, i]
        if not (rows.any() and np.isfinite(before[rows, i]).all()):
            continue
        if not np.isfinite(after[rows, i]).all():
            return True  # solutions that only a coarse step keeps from blowing up
        with np.errstate(over="ignore"):
            change, noise = (np.sqrt(2 * mean_loss(r[rows, i])) for r in (before - after, after))
        if not np.isfinite(noise):
            return True
        if change <= least:
            continue
        if change > SHOWS * noise:
            return True
        suspect = suspect or bool(change > SHOWS * noise / np.sqrt(rows.sum()))
    if not (suspect and constants and parameters.shared):
        return False
    if not parameters.n_weights:
        return True
    change = np.where(np.isfinite(after - before), after - before, 0.0)
    return moved(now, theta, measured_only(now.problem, change)) > SHOWS


def states_move(now: Engine, half: Engine, quarter: Callable[[], Engine], theta: Array) -> bool:
    """Whether halving the step moves a state, measured or not, by more than the share of its range that the check of a
    fit allows (`gbspec.runs.DEPENDS`), and halving it again by clearly less.

    A compartment that nothing measures may pass a fast transient in the first rows: no residual shows the error there,
    but predictions, figures and exported code have it. Beside a jump no step is short enough.
    """
    coarse, fine = (predicted(engine, theta).before for engine in (now, half))  # [R, n_states]
    first = _share_of_range(coarse, fine)
    if not first > DEPENDS:
        return False
    return first == np.inf or _share_of_range(fine, predicted(quarter(), theta).before) <= HELPS * first


def _share_of_range(coarse: Array, fine: Array) -> float:
    """The largest difference of states [R, n_states], relative to their ranges (of a constant one to its size);
    infinite where only the coarse ones are finite."""
    known = np.isfinite(coarse).all(axis=1)
    coarse, fine = coarse[known], fine[known]
    if not len(fine):
        return 0.0
    if not np.isfinite(fine).all():
        return np.inf
    size, width = np.abs(fine).max(axis=0), np.ptp(fine, axis=0)
    scale = np.where(width > FLAT * size, width, np.maximum(size, 1e-12))
    return float(np.max(np.abs(fine - coarse) / scale))


def astray(engine: Engine, theta: Array) -> Mask:
    """The measured rows [R, C] at which solutions blow up, or are far outside of the range of a channel's data.

    Neither the noise nor the distance from a single measurement counts: both say something of the fit, not of its step.
    """
    problem, mean = engine.problem, predicted(engine, theta).mean
    out = np.zeros(mean.shape, dtype=np.bool_)
    for i in range(mean.shape[1]):
        seen, data = problem.seen[:, i], problem.packed.values[problem.valued[:, i], i]
        wide = APART * float(data.std()) if len(data) and data.std() > 0 else np.inf
        low, high = (data.min() - wide, data.max() + wide) if len(data) else (-np.inf, np.inf)
        out[seen, i] = ~(np.isfinite(mean[seen, i]) & (mean[seen, i] >= low) & (mean[seen, i] <= high))
    return out


class FinerStep(LevenbergMarquardt):
    """Levenberg-Marquardt with a finer step, which it shows.

    Where solutions blow up at this step, or are far from the data, it begins from the vector that `elsewhere` finds.
    """

    def __init__(
        self, of: LevenbergMarquardt, remark: str, elsewhere: Callable[[Array], Array] = lambda theta: theta
    ) -> None:
        super().__init__(of.name, of.total, of.engine_at, of.options)
        self.remark, self.elsewhere = remark, elsewhere

    def begin(self, theta: Array) -> State:
        """The state of the optimiser. Raises ComputationError if solutions blow up at this step wherever it begins."""
        engine = self.engine_at(0)
        if astray(engine, theta).any():
            theta = self.elsewhere(theta)
            if astray(engine, theta).any():
                what = "solutions blow up, or are far from the data, at half the solver's step"
                raise ComputationError(what, remedy="fit again with a smaller `--max-step`")
        return super().begin(theta)

    def step(self, state: State, iteration: int) -> Outcome:
        """One iteration, with the step in its remark; none is needed where residuals are small at this step too."""
        if iteration == 0 and self.name == StageName.FINER:
            residuals = residual_vector(self.engine_at(0), state["theta"])
            if self.close(state["theta"], residuals):
                return Outcome(state, mean_loss(residuals), True, remark=self.remark)
        outcome = super().step(state, iteration)
        return Outcome(outcome.state, outcome.loss, outcome.done, outcome.note, self.remark)


def finer_step(context: Context, number: int, last: Callable[[Reached], LastFit | None], effort: Effort) -> Planned:
    """Continues the last fit at half its step (adaptive: a tenth of its tolerance), where the error shows and the step
    is not one that the user gave. `number` counts these stages."""
    most = most_iterations(StageName.FINER, effort)

    def make(reached: Reached) -> Stage:
        found, fraction = last(reached), step_fraction(reached.begun) / 2
        assert found is not None, "the stage has begun"
        layout, blend = found.layout, found.blend
        chosen = continuing(found.options(reached), reached)
        newton = LevenbergMarquardt(StageName.FINER, most, lambda i: context.engine(layout, blend, fraction, i), chosen)
        rtol = context.tolerance(fraction)
        size = f"largest step {fraction * context.max_step:.3g}" if rtol is None else f"tolerance {rtol:.3g}"
        before = "twice this step" if rtol is None else "ten times this one"
        said = f"{size}, since the error of {before} showed"
        said += " in states" if (reason := why(reached)) == STATES else ""
        if reason == LIMITED:
            said = f"{size}, since solutions were near the limit of stability of {before}"

        def elsewhere(theta: Array) -> Array:
            """Other initial states, or else what segments lead to."""
            found = refit_starts(newton.engine_at(0), theta, context.seed)
            again = GrowingHorizons(context.finer(fraction), layout, [found], effort)
            return again.run(found) if astray(newton.engine_at(0), found).any() and again.horizons else found

        return FinerStep(newton, said, elsewhere)

    def why(reached: Reached) -> str:
        """Why a finer step is needed; empty if it is not."""
        found, size = last(reached), step_fraction(reached.begun)
        assert found is not None, "the fit before has begun"
        now, half = (context.engine(found.layout, found.seen, part) for part in (size, size / 2))
        least = LEAST_ADAPTIVE if context.adaptive else LEAST_ERROR
        if step_shows(now, half, reached.theta, found.constants, least):
            return INEXACT
        if _near_limit(context, found.layout, reached.theta, size):
            return LIMITED
        if context.adaptive:
            return ""
        quarter = partial(context.engine, found.layout, found.seen, size / 4)
        return STATES if states_move(now, half, quarter, reached.theta) else ""

    def possible(reached: Reached) -> bool:
        given = context.options.tolerance if context.adaptive else context.options.max_step
        if given is not None or last(reached) is None:
            return False
        return list(reached.begun).count(StageName.FINER) == number - 1 and bool(why(reached))

    return Planned(StageName.FINER, most, make, possible=possible)


def _near_limit(context: Context, layout: Parameters, theta: Array, fraction: float) -> bool:
    """Whether whole solutions of known functions are near the limit of stability of an explicit step.

    Beyond it solutions are wrong, so that no fit goes there: constants that the data do not hold come to rest before
    it, with deviations that are those of the steps. At half the step they move on, or stay where the data hold them.
    """
    if context.model.networks or context.adaptive:
        return False
    engine = context.engine(layout, 0.0, fraction)
    states = predicted(engine, theta).before
    return times_step(context, engine.problem, layout, theta, fraction, states)[1] > NEAR * LIMIT
