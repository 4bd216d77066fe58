"""Constants that the curvature of a fit leaves open although the data hold them.

A standard deviation is computed from the curvature at the estimate. Where that vanishes while the sum of squares still
rises further off (two rates that may be exchanged, and meet), it says nothing. Before constants are called open, the
fit with each of them held further and further on the way to its bounds, and all else refitted, tells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations

from gbspec.arrays import Array
from gbspec.ir import Learnable, Model
from gbspec.runs import Covariance
from gbspec.training.population import LOWER, Counted, Objective, Point, PopulationResult, SpentError, with_held
from gbspec.training.problem import Parameters
from gbspec.training.recipe import Context, only_in_jumps
from gbspec.training.runs.constants import EXACT, at_bounds, covers, half_width, inside_bounds
from gbspec.training.runs.deviance import Deviance, Held, Rise, held_by_data, last_passed
from gbspec.training.runs.misjudged_own import open_own, taken_own
from gbspec.training.runs.summary import MemberResult

EQUAL = 0.05
"""Two constants of one unit that differ by a smaller part may be two that can be exchanged."""
MOST_BESIDE_FUNCTIONS = 2
"""So many constants are tested in a fit with unknown functions, whose weights are refitted too."""
EVALUATIONS = 240
"""Values, gradients and curvatures of a marginal likelihood that all constants of a fit may take together; a constant
that they do not decide is not tested."""


def without_misjudged(
    result: MemberResult,
    context: Context,
    parameters: Parameters,
    theta: Array,
    stages: Sequence[str],
    known: Covariance | None = None,
) -> list[str]:
    """Takes their standard deviations from constants of a fit of squares that the data hold although the curvature
    does not; what is to be said of them. `stages` are those that led to `theta`; the covariance that is `known` has the
    prior of the weights of networks."""
    model = context.model
    if model.diffusions or model.marginal or not result.loss > EXACT:
        return []
    shared = [model.learnables[i] for i in parameters.shared]
    open_ones = open_constants(result, model, shared)
    own = [] if parameters.n_weights else open_own(result, model)
    deviance = Deviance.of(result, context, parameters, theta, stages, known) if open_ones or own else None
    if deviance is None:
        result.untested |= frozenset(k.name for k in open_ones)
        return []
    tested = open_ones[: MOST_BESIDE_FUNCTIONS if parameters.n_weights else None]
    each = [deviance.held(k, parameters.n_weights + shared.index(k), result.constants[k.name]) for k in tested]
    found = [one for one in each if one is not None]
    unknown = deviance.unknown | {k.name for k in open_ones[len(tested) :]}
    result.untested |= frozenset(unknown - {one.learnable.name for one in found})
    return [*_taken(result, found), *taken_own(result, deviance, parameters, own)]


def misjudged_of_population(result: MemberResult, objective: Objective, found: PopulationResult) -> list[str]:
    """The same of a marginal likelihood: of medians of distributions, and of constants of all trajectories."""
    model, known = objective.layout.model, found.estimates
    solved = objective.marginal.predictions.problem.model
    jumping = only_in_jumps(solved)  # of these there is more to say (`unmoved`)
    places = {name: place for name, place in objective.layout.typical.items() if name not in jumping}
    threshold = half_width([result]) ** 2
    counted, lower, spent = Counted(objective, EVALUATIONS), dict[str, tuple[float, float]](), set[str]()

    def rise_of(name: str) -> Rise:
        place = places[name]
        passed: dict[float, Point] = {float(known.value[place]): found.point}

        def rise(value: float) -> float:
            start = last_passed(passed, value, float(known.value[place]))
            try:
                objective_there, point = with_held(counted, found.point, found.ridge, place, value, start, threshold)
            except SpentError:
                spent.add(name)
                return -math.inf
            fall = found.point.objective - point.objective
            if fall > max(LOWER, lower.get(name, (0.0, 0.0))[1]):
                lower[name] = (value, fall)
            if math.isfinite(objective_there):
                passed[value] = point
            else:
                spent.add(name)
            return objective_there - found.point.objective

        return rise

    open_ones = open_constants(result, model, [k for k in model.learnables if k.name in places])
    each = (held_by_data(k, result.constants[k.name], rise_of(k.name), threshold) for k in open_ones)
    held = [one for one in each if one is not None]
    said = _taken(result, held)
    result.untested |= frozenset(spent - result.misjudged)
    return [*said, *(_of_lower(name, *one) for name, one in lower.items())]


def _of_lower(name: str, value: float, fall: float) -> str:
    """What is said of a lower minimum that was found with a constant held."""
    return (
        f"there is a lower minimum: with {name} = {value:.3g}, and all else refitted, -2 log L is {fall:.2g} lower "
        f"than at the estimate. What may help: begin there (`learn {name} = {value:.3g}`), or `--effort high`"
    )


def open_constants(result: MemberResult, model: Model, learnables: Iterable[Learnable]) -> list[Learnable]:
    """The constants whose intervals, by the curvature, cover their bounds."""
    ended = dict(at_bounds(model, result.constants, result.sd))

    def interval(k: Learnable) -> tuple[float, float] | None:
        sd = result.sd.get(k.name, math.nan)
        known = math.isfinite(sd) and k.name not in ended
        return inside_bounds(k, result.constants[k.name], sd, half_width([result])) if known else None

    return [k for k in learnables if covers(k, interval(k))]


def _taken(result: MemberResult, held: Sequence[Held]) -> list[str]:
    """Takes their standard deviations from constants that the data hold; a sentence of them."""
    if not held:
        return []
    names = [one.learnable.name for one in held]
    listed = ", ".join(f"`{name}`" for name in names[:-1]) + " and " * (len(names) > 1) + f"`{names[-1]}`"
    result.sd |= dict.fromkeys(names, math.nan)
    result.misjudged |= frozenset(names)
    result.at_most |= {one.learnable.name: one.spread(half_width([result])) for one in held}
    verb = "has" if len(held) == 1 else "have"
    tried = ", or ".join(f"{one.learnable.name} = {' or '.join(f'{value:.3g}' for value in one.worse)}" for one in held)
    said = (
        f"{listed} {verb} no interval: the curvature at the estimate, from which "
        f"intervals are computed, leaves {'it' if len(held) == 1 else 'them'} open, and the data do not: with "
        f"{tried}, and all else refitted, the fit is clearly worse. `gbspec profile` gives intervals"
    )
    return [said + _exchanged(held)]


def _exchanged(held: Sequence[Held]) -> str:
    """What is said of two constants that meet."""
    for a, b in combinations(held, 2):
        size = max(abs(a.estimate), abs(b.estimate))
        if a.learnable.unit == b.learnable.unit and abs(a.estimate - b.estimate) <= EQUAL * size:
            return (
                f". `{a.learnable.name}` and `{b.learnable.name}` have the same value: where two rates in turn can be "
                "exchanged, the curvature vanishes where they meet. The data may ask for one rate, or for a damped "
                "oscillation, which no two rates give"
            )
    return ""
