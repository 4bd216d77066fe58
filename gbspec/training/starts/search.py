"""The search for the best minimum of a model whose functions are all known.

Points are drawn over the whole ranges of the constants; those from which the model cannot be solved are discarded. The
given vector, the declared starting values and the best draws are then improved by Levenberg-Marquardt, one in each
step, until the best minimum has been found several times or the effort is spent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from gbspec.arrays import Array, Mask
from gbspec.data import sobol, spread_over_ranges
from gbspec.diagnostics import ComputationError
from gbspec.ir import may_jump
from gbspec.runs import SearchRecord
from gbspec.training.engines import (
    Engine,
    TorchEngine,
    explain_failure,
    happened,
    residual_table,
    residual_vector,
)
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, Priors, State, equal, huber
from gbspec.training.problem import Problem, autocorrelation_of, in_time, mean_loss
from gbspec.training.stages import Effort, StageName
from gbspec.training.starts.edges import at_jumps
from gbspec.training.starts.own_constants import refit_own
from gbspec.training.starts.sizes import solved_starts

CLOSE = 1e-10
"""Losses of the same minimum differ by less than this, where they do not relatively (`equal.SAME`)."""
ITERATIONS, FORCED = 60, 15
"""Largest numbers of iterations from one start: of whole solutions, and with teacher forcing before them."""
EXACT = 1e-14
"""Mean loss at which a start needs no further iteration."""
OPTIONS = LevenbergOptions(robust=False, tolerance=1e-4, damping=1e-1)
WORK = 2e7
"""Sub-steps times columns over which the improvements of all starts may extend, so that large data get fewer starts."""
FEWEST = 6
"""Starts that are drawn and improved however large the data are."""
FOLLOWING = 0.75
"""Residuals follow one another if their correlation with the next ones is above this, by twice its standard error: a
minimum with such residuals is wrong, or the model cannot follow the data. (Less is left by the noise of measured first
values.)"""
FOLLOWED = 1e-7
"""Mean loss up to which a minimum is good whatever its residuals: they are less than 0.05 % of the deviations."""
LARGEST = 10**7
"""Largest number of entries of all draws."""
WORSE, CLEARLY = 0.05, 10.0
"""A minimum is a worse one if its loss is larger by this share, and -2 log likelihood by so much."""
OFTEN = 4
"""How much more often a minimum has to be found whose residuals do not look like noise: a better one may exist."""

MOST_MINIMA = 4
"""So many minima that are equally good are remembered."""
SETTLED = 1e-6
"""The relative fall of the objective at which those that are compared have come to rest."""
PIECES = 24
"""So many values of a constant at which the sum of squares jumps are tried."""
IDLE = 0.1
"""A constant by whose change by this (on the scale of training) no residual changes is not compared."""


@dataclass(frozen=True)
class Patience:
    """The effort of a search: `draws`, of which at most `improved` are improved; at least `least` are, and the search
    ends when the best minimum has been found `times` times (`OFTEN` as many, if its residuals follow one another)."""

    draws: int
    improved: int
    least: int
    times: int


PATIENCE: Mapping[Effort, Patience] = {
    "low": Patience(64, 8, 4, 2),
    "normal": Patience(256, 64, 8, 3),
    "high": Patience(1024, 192, 24, 6),
}
WITH_STARTS: Mapping[Effort, Patience] = {
    "low": Patience(64, 6, 4, 2),
    "normal": Patience(256, 16, 6, 3),
    "high": Patience(1024, 48, 12, 6),
}
"""The same where measured initial values are estimated too, after a search in which they were taken as they are."""


def patience_of(effort: Effort, engine: Engine) -> Patience:
    """The effort for an engine: the torch graph takes a hundred times as long as the kernel for delays."""
    full = PATIENCE[effort]
    if engine.problem.model.delays and isinstance(engine, TorchEngine):
        return Patience(full.draws // 8, full.improved // 4, min(full.least, 3), 2)
    return full


def starts_within(patience: Patience, substeps: int, columns: int) -> int:
    """The largest number of starts that are improved for data with `substeps` sub-steps."""
    return int(np.clip(WORK / max(substeps * (columns + 10), 1), min(FEWEST, patience.improved), patience.improved))


def followed(residuals: Array, problem: Problem) -> bool:
    """Whether residuals [R, C] are correlated with the next ones of the same trajectory and channel."""
    rows = [in_time(problem, i) for i in range(residuals.shape[1])]
    owners = [problem.packed.row_trajectory[each] + i * problem.packed.trajectories for i, each in enumerate(rows)]
    ours = [residuals[each, i] for i, each in enumerate(rows)]
    correlation, pairs = autocorrelation_of(np.concatenate(ours), np.concatenate(owners))
    return correlation is not None and correlation > FOLLOWING + 2 / math.sqrt(pairs)


def robust_loss(engine: Engine, theta: Array) -> float:
    """Huber's loss with the priors, by which draws are compared: far from any minimum, few residuals must not decide.
    Infinite without a solution."""
    residuals = residual_vector(engine, theta)
    return huber(residuals, 1.0) + _penalty(engine, theta, residuals)


def _penalty(engine: Engine, theta: Array, residuals: Array) -> float:
    """The contribution of the priors to half the sum of squares."""
    if not np.isfinite(residuals).all():
        return 0.0
    return Priors.of(engine.problem, engine.parameters, residuals).penalty(theta)


class Search:
    """One start in each step: the given vector, the declared starting values, then the draws from the best one on.

    Every third start is first improved with teacher forcing by `forced`: errors from one measurement to the next have
    fewer minima than those of whole solutions, whose best one they often lead to. The initial values of states of
    unknown size (`unsized`) are solved for at each draw: they go with its constants. Of other learned initial states
    those are drawn that `drawn` [N, n_states] has as 1 (default: all). `finer` makes the engine with half the step, at
    which minima that seem to be equally good are looked at again: a step that is too long may make them up.
    """

    def __init__(
        self,
        engine: Engine,
        forced: Engine | None,
        seed: int,
        effort: Effort,
        unsized: Mask | None = None,
        patience: Patience | None = None,
        name: StageName = StageName.SEARCH,
        drawn: Array | None = None,
        finer: Callable[[], Engine] | None = None,
    ) -> None:
        self.name, self.finer = name.value, finer
        self.engine, self.forced, self.parameters, self.seed = engine, forced, engine.parameters, seed
        self.unsized, self.drawn = unsized, self.parameters.start_free if drawn is None else drawn
        self.patience = patience or patience_of(effort, engine)
        self.options, self.iterations = OPTIONS, ITERATIONS
        columns = self.parameters.n_shared + self.parameters.n_local
        self.count = max(int(engine.problem.seen.sum()), 1)
        self.indistinct, self.unclear = equal.indistinct(self.count), equal.unclear(self.count)
        self.total = starts_within(self.patience, int(engine.problem.packed.steps.sum()), columns)

    def begin(self, theta: Array) -> State:
        """The initial state: the vector, and the starts from the best one on.

        Raises ComputationError if the model can be solved from none of them.
        """
        candidates, losses = self.losses(theta)
        if not np.isfinite(losses).any():
            raise self._none_survived(theta, len(losses))
        order = [i for i in self._order(losses) if np.isfinite(losses[i])]
        best = int(np.argmin(losses))
        return {
            "theta": candidates[best],
            "best": np.array(self._objective(candidates[best])),
            "starts": candidates[order[: self.total]],
            "found": np.zeros(0),
            "minima": np.zeros((0, candidates.shape[1])),
            "values": np.zeros(0),
            "survived": np.array(float(np.isfinite(losses).sum())),
            "drawn": np.array(float(len(losses))),
            "endless": np.array(float(sum(self._endless(candidates[i]) for i in np.flatnonzero(~np.isfinite(losses))))),
        }

    def _endless(self, theta: Array) -> bool:
        """Whether events follow each other without end at a vector from which the model cannot be solved."""
        found = happened(self.engine, theta)
        return found is not None and bool(found.endless.any())

    def losses(self, theta: Array) -> tuple[Array, Array]:
        """The points from which the search starts [n, size], and their losses; not finite without a solution."""
        candidates = self._candidates(theta)
        return candidates, np.array([robust_loss(self.engine, candidate) for candidate in candidates])

    def _order(self, losses: Array) -> list[int]:
        """The order of the starts: the first two, and the draws from the best one on.

        At effort high those come first that effort normal has, in its order: what normal finds is found too.
        """
        normal = patience_of("normal", self.engine)
        first = min(normal.draws, len(losses) - 2)
        known = [0, 1, *(2 + np.argsort(losses[2 : 2 + first], kind="stable")).tolist()]
        known = [i for i in known if np.isfinite(losses[i])][: normal.improved]
        return [*known, *(i for i in (2 + np.argsort(losses[2:], kind="stable")).tolist() if i not in known)]

    def step(self, state: State, iteration: int) -> Outcome:
        """Improves one start."""
        starts, theta, best = state["starts"], state["theta"], float(state["best"])
        reached, vector = self._improve(starts[iteration], iteration)
        if reached < best:
            theta, best = vector, reached
        found = np.append(state["found"], reached)
        count, near = self._reached(found, best)
        search = SearchRecord(len(found), count, near)  # before constants of single trajectories lower the best one
        minima = self._minima(state, reached, vector, best)
        times = self.patience.times * (1 if self._plausible(theta, best) else OFTEN)
        enough = len(found) >= self.patience.least and count >= times
        done = enough or iteration + 1 >= len(starts)
        if done:
            minima = self._lasting(minima)
            theta, best = self._best_of_own(self._preferred(minima, theta, best), best)
            theta, best = self._best_of_pieces(theta, best)
        endless = int(state.get("endless", 0))
        why = f" (in {endless} events follow each other without end)" if endless else ""
        remark = f"{int(state['survived'])} of {int(state['drawn'])} starts can be solved{why}, {search}"
        new: State = state | {"theta": theta, "best": np.array(best), "found": found, **minima}
        note = self._others(minima, theta) if done else ""
        return Outcome(new, mean_loss(residual_vector(self.engine, theta)), done, note, remark, search)

    def _reached(self, found: Array, best: float) -> tuple[int, int]:
        """How many of the objectives are the best one, and how many others are of no worse minimum."""
        same = found <= best * (1 + equal.SAME) + CLOSE
        no_worse = found <= best * (1 + max(WORSE, CLEARLY / self.count))
        return int(same.sum()), int((no_worse & ~same).sum())

    # ---------------------------------------------------------------- minima that are equally good
    def _minima(self, state: State, reached: float, vector: Array, best: float) -> State:
        """The minima that the data do not tell from the best one, and their objectives, with the one that was just
        reached if it is new."""
        minima = state.get("minima", np.zeros((0, len(vector))))  # a search that an older version began has none
        values = state.get("values", np.zeros(0))
        as_good = best * (1 + self.unclear) + EXACT
        if reached <= as_good and all(self._apart(vector, one, self.engine) for one in minima):
            minima, values = np.concatenate([minima, vector[None]]), np.append(values, reached)
        first = np.sort(np.argsort(values, kind="stable")[:MOST_MINIMA])
        kept = first[values[first] <= as_good]
        return {"minima": minima[kept], "values": values[kept]}

    def _lasting(self, minima: State) -> State:
        """Of several minima those that are as good at half the step, with their objectives there.

        A fast decay makes solutions up where the step is too long for it, and such a solution may fit: with half the
        step it is another one. A start may also rest on its way to another one's minimum.
        """
        vectors = minima["minima"]
        if self.finer is None or len(vectors) < 2:
            return minima
        half = self.finer()
        settled = np.array([self._descended(half, one, self.iterations, SETTLED) for one in vectors])
        values = np.array([self._objective(one, half) for one in settled])
        as_good = float(values.min()) * (1 + self.unclear) + EXACT
        kept: list[int] = []
        for i in np.argsort(values, kind="stable"):
            stays = self._objective(vectors[i], half) <= as_good or not self._differ(vectors[i], settled[i])
            if stays and values[i] <= as_good and all(self._apart(settled[i], settled[j], half) for j in kept):
                kept.append(int(i))
        return {"minima": vectors[kept], "values": values[kept]}

    def _differ(self, one: Array, other: Array) -> bool:
        """Whether a constant differs clearly between two vectors."""
        return equal.differ(self._shared(one), self._shared(other))

    def _apart(self, one: Array, other: Array, engine: Engine) -> bool:
        """Whether two vectors are separate minima: a constant differs clearly, and half-way between them is worse."""
        if not self._differ(one, other):
            return False
        highest = max(self._objective(one, engine), self._objective(other, engine))
        return not self._objective(0.5 * (one + other), engine) <= highest * (1 + self.indistinct) + EXACT

    def _shared(self, theta: Array) -> Array:
        """The constants that all trajectories share, in natural units."""
        scale = self.parameters.bijections(self.parameters.shared)
        return np.asarray(scale.to_natural(torch.from_numpy(theta[self.parameters.places])).numpy())

    def _preferred(self, minima: State, theta: Array, best: float) -> Array:
        """Of equally good minima the one nearest to the declared starting values: the data do not choose."""
        values = minima["values"]
        as_good = minima["minima"][values <= values.min(initial=np.inf) * (1 + self.indistinct) + EXACT]
        if not len(as_good):
            return theta
        declared = self.parameters.vector(self.parameters.natural(theta))[self.parameters.places]
        nearest = np.asarray(as_good[equal.nearest(as_good[:, self.parameters.places], declared)])
        return nearest if self._differ(nearest, theta) else theta

    def _others(self, minima: State, theta: Array) -> str:
        """A warning of minima that the data do not tell from the one that was taken."""
        told = [(self._text(one), value) for one, value in self.rivals(minima, theta)]
        if not told:
            return ""
        least = float(minima["values"].min())
        rises = [self.count * math.log(value / least) if least > EXACT else 0.0 for _, value in told]
        return equal.said_of_others([(text, rise) for (text, _), rise in zip(told, rises, strict=True)], self.count)

    def rivals(self, minima: State, theta: Array) -> list[tuple[Array, float]]:
        """The minima of a state other than the one that was taken, with their objectives."""
        pairs = zip(minima["minima"], minima["values"], strict=True)
        return [(one, float(value)) for one, value in pairs if self._apart(one, theta, self.engine)]

    def _text(self, theta: Array) -> str:
        """The constants of a vector by which solutions change (the size of a learned noise does not change them)."""
        learnables, before = self.parameters.model.learnables, residual_vector(self.engine, theta)
        texts = []
        for i, value in zip(range(len(self.parameters.shared)), self._shared(theta), strict=True):
            moved = theta.copy()
            moved[self.parameters.n_weights + i] += IDLE
            if not np.array_equal(residual_vector(self.engine, moved), before):
                texts.append(f"{learnables[self.parameters.shared[i]].name} {value:.3g}")
        return ", ".join(texts)

    def _plausible(self, theta: Array, best: float) -> bool:
        """Whether the residuals at a vector look like noise."""
        return best <= FOLLOWED or not followed(residual_table(self.engine, theta), self.engine.problem)

    # ---------------------------------------------------------------- starts
    def _candidates(self, theta: Array) -> Array:
        """The given vector, the declared starting values, and draws [n, size]; learned initial states are drawn too, in
        every other draw."""
        parameters = self.parameters
        count = int(np.clip(LARGEST // parameters.size, FEWEST, self.patience.draws))
        declared = parameters.vector(parameters.natural(theta))
        declared[parameters.n_shared :] = self._blocks(theta, declared).ravel()
        learnables = parameters.model.learnables
        n_constants, n_states = len(learnables), len(parameters.model.states)
        points = sobol(count, n_constants + n_states, self.seed)
        natural = spread_over_ranges(learnables, points[:, :n_constants])
        out = [theta, declared]
        for i in range(count):
            drawn = parameters.vector(parameters.natural(theta), natural[i])
            blocks = self._blocks(theta, drawn)
            if i % 2:
                blocks[:, len(parameters.own) :] += self.drawn * (2 * points[i, n_constants:] - 1)
            drawn[parameters.n_shared :] = blocks.ravel()
            out.append(drawn if self.unsized is None else solved_starts(self.engine, drawn, self.unsized))
        return np.array(out)

    def _blocks(self, theta: Array, drawn: Array) -> Array:
        """The trajectories' blocks with the constants of `drawn` and the initial states of `theta`."""
        own, shape = len(self.parameters.own), (self.parameters.trajectories, self.parameters.n_local)
        blocks = theta[self.parameters.n_shared :].reshape(shape).copy()
        blocks[:, :own] = drawn[self.parameters.n_shared :].reshape(shape)[:, :own]
        return blocks

    def _none_survived(self, theta: Array, count: int) -> ComputationError:
        cause = explain_failure(self.engine.problem, self.parameters, self._candidates(theta)[1], self.name)
        what = f"the model cannot be solved from any of {count} starts; from the declared one {cause.what}"
        return ComputationError(what, where=cause.where, remedy=cause.remedy)

    # ---------------------------------------------------------------- objective
    def _objective(self, theta: Array, engine: Engine | None = None) -> float:
        engine = engine or self.engine
        residuals = residual_vector(engine, theta)
        return mean_loss(residuals) + _penalty(engine, theta, residuals) / max(len(residuals), 1)

    # ---------------------------------------------------------------- improvement
    def _improve(self, theta: Array, place: int) -> tuple[float, Array]:
        if self.forced is not None and place % 3 == 2:
            theta = self._descended(self.forced, theta, FORCED)
        if self.parameters.own:
            theta = refit_own(self.engine, theta, self.seed, 32, 2)
        theta = self._descended(self.engine, theta, self.iterations)
        return self._objective(theta), theta

    def _best_of_own(self, theta: Array, best: float) -> tuple[Array, float]:
        """The best vector after another look for better constants of single trajectories."""
        for attempt in range(3 if self.parameters.own else 0):
            trial = self._descended(self.engine, refit_own(self.engine, theta, self.seed + attempt), self.iterations)
            reached = self._objective(trial)
            if not reached < best * (1 - equal.SAME):
                break
            theta, best = trial, reached
        return theta, best

    def _best_of_pieces(self, theta: Array, best: float) -> tuple[Array, float]:
        """The best vector after constants at which the sum of squares jumps were begun at values over their ranges."""
        if best <= FOLLOWED or not may_jump(self.engine.problem.model):
            return theta, best
        scale, shared = self.parameters.bijections(self.parameters.shared), self.parameters.shared
        for place in at_jumps(self.engine, self._descended(self.engine, theta, self.iterations, SETTLED)):
            learnable = self.parameters.model.learnables[shared[place]]
            for value in spread_over_ranges((learnable,), (np.arange(PIECES)[:, None] + 0.5) / PIECES)[:, 0]:
                natural, trial = self._shared(theta), theta.copy()
                natural[place] = value
                trial[self.parameters.places] = scale.from_natural(natural)
                trial = self._descended(self.engine, trial, self.iterations)
                reached = self._objective(trial)
                if reached < best:
                    theta, best = trial, reached
        return theta, best

    def _descended(self, engine: Engine, theta: Array, iterations: int, tolerance: float | None = None) -> Array:
        """The vector after some iterations of Levenberg-Marquardt, or the last one from which they were possible."""
        control = engine.problem.control
        # Adaptive steps: below a tenth of the tolerance, residuals are the error of the steps.
        least = 0.0 if control is None else 0.5 * (0.1 * control.rtol) ** 2
        options = replace(self.options, enough=max(EXACT, least), tolerance=tolerance or self.options.tolerance)
        stage = LevenbergMarquardt(self.name, iterations, lambda i: engine, options)
        state = stage.begin(theta)
        for i in range(iterations):
            try:
                outcome = stage.step(state, i)
            except ComputationError:
                break
            state = outcome.state
            if outcome.done:
                break
        return state["theta"]
