"""Constants whose estimates follow from another one's bound, so that they have no interval of their own.

A constant that ended at its bound is fixed there in the curvature of a fit. Where the data tie others to it, their
standard deviations hold if it is at the bound, and say nothing of what the data alone tell: either the linearised fit
with both free shows that, or, where only constants are learned, fits on the way inside from the bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.runs import Covariance
from gbspec.training.engines import Engine, TorchEngine, residual_vector
from gbspec.training.optimise import Anchor, Certainty, Penalised, Rest, loosened, minimise, noise_variance
from gbspec.training.problem import Bijection, Bijections, Integers, Parameters
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.constants import EXACT, at_bounds, half_width, inside_bounds
from gbspec.training.runs.summary import MemberResult, whole_solutions
from gbspec.training.runs.verdict import widening

INSIDE = 1e-5
"""Constants at bounds count as so far inside of them (as a fraction of the range on the scale of training), where the
slopes of this scale can still be computed."""
TIED = 3.0
"""Constants are tied to those at bounds where their standard deviations are over this many times as large with these
free."""
WAY = (0.01, 0.03, 0.07, 0.15, 0.25, 0.4, 0.6, 0.8)
"""Shares of the range, on the scale of training, by which a constant is moved inside from its bound."""
ACCURACY, WEAK = 0.02, 1e-3
"""A fit on this way has converged if its deviance is not predicted to fall by more; the damping of its directions."""
STEPS, JACOBIANS = 12, 4
"""Steps with one Jacobian, and Jacobians, of each such fit."""
LARGEST = 2**24
"""The most entries of a Jacobian with which constants are followed on this way: there are hundreds of them."""
HELPS = "A prior, or a value that is known (`const`), helps"
SHOWN = f"`gbspec profile` shows what the data say. {HELPS}"


@dataclass(frozen=True)
class Followed:
    """A constant that leaves its interval, `low` to `high`, as another one moves inside from its bound: to `value`,
    when that one is at `inner`."""

    name: str
    low: float
    high: float
    bounded: str
    inner: float
    value: float

    @property
    def words(self) -> str:
        """A sentence for the summary."""
        return (
            f"`{self.name}` has no interval: the data tie its value to `{self.bounded}`, which ended at a bound; while "
            f"they allow `{self.bounded}` to be inside of it, at {self.inner:.3g}, `{self.name}` is {self.value:.3g} "
            f"there, and its interval at the bound would be {self.low:.4g} to {self.high:.4g}"
        )


def without_tied(
    result: MemberResult,
    context: Context,
    parameters: Parameters,
    theta: Array,
    stages: Sequence[str],
    known: Mapping[str, float] | None = None,
) -> list[str]:
    """Takes their intervals from constants that follow from another one's bound; what is to be said of them. `stages`
    are those that led to `theta`; `known`: the factors of those that another curvature has shown to be tied."""
    at = dict(at_bounds(context.model, result.constants, result.sd)) if result.loss > EXACT else {}
    ended = [context.model.learnables[i].name for i in parameters.shared if context.model.learnables[i].name in at]
    if not ended or context.model.diffusions:
        return []
    result.bounded |= frozenset(ended)
    blend = 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
    engine = context.engine(parameters, blend, step_fraction(stages))
    tied = tied_to_bounds(engine, theta, ended)
    tied |= {name: max(factor, tied.get(name, 0.0)) for name, factor in (known or {}).items()}
    result.sd |= dict.fromkeys(tied, math.nan)
    followed = []
    # Jacobians of delays by the torch graph take seconds each.
    if not parameters.n_weights and not (context.model.delays and isinstance(engine, TorchEngine)):
        threshold = (half_width([result]) * widening(result.channels or {})) ** 2
        followed = _followed(
            context, engine, theta, {name: at[name] for name in ended}, _intervals(result, context), threshold
        )
        result.sd |= {one.name: math.nan for one in followed}
    result.tied_to_bounds |= frozenset((*tied, *(one.name for one in followed)))
    return [*said_of_tied(tied, ended, SHOWN), *(f"{one.words}. {SHOWN}" for one in followed)]


def _intervals(result: MemberResult, context: Context) -> dict[str, tuple[float, float]]:
    """The intervals of the constants that have one."""
    each = {k.name: k for k in context.model.learnables}
    found = {
        name: inside_bounds(each[name], result.constants[name], sd, half_width([result]))
        for name, sd in result.sd.items()
        if math.isfinite(sd) and not each[name].per_trajectory
    }
    return {name: ends for name, ends in found.items() if ends is not None}


def _followed(
    context: Context,
    engine: Engine,
    theta: Array,
    at: Mapping[str, float],
    intervals: Mapping[str, tuple[float, float]],
    threshold: float,
) -> list[Followed]:
    """The constants that leave their `intervals` while those `at` bounds move inside as far as the data allow: until
    the deviance, with everything else refitted, is above the `threshold`."""
    parameters = engine.parameters
    if len(residual_vector(engine, theta)) * parameters.size > LARGEST:
        return []
    target, variance = penalised(context, engine, theta)
    names = [parameters.model.learnables[i].name for i in parameters.shared]
    furthest: dict[str, tuple[float, Followed]] = {}
    for bounded, bound in at.items():
        for values in _inwards(target, theta, names.index(bounded), bound, variance, threshold):
            natural = dict(zip(names, map(float, values), strict=True))
            for name, (low, high) in intervals.items():
                beyond = max(low - natural[name], natural[name] - high) if name not in at else 0.0
                if beyond > (furthest[name][0] if name in furthest else 0.0):
                    furthest[name] = beyond, Followed(name, low, high, bounded, natural[bounded], natural[name])
    return [furthest[name][1] for name in names if name in furthest]


def penalised(
    context: Context, engine: Engine, theta: Array, known: Covariance | None = None
) -> tuple[Penalised, float]:
    """The sum of squares of a fit, and the variance of its noise at a vector. Weights of networks, whose prior is that
    of the covariance that is `known`, are drawn to those of the vector, as a profile does."""
    parameters, residuals = engine.parameters, residual_vector(engine, theta)
    used = len(parameters.shared) + float(parameters.free[parameters.n_shared :].sum())
    used += float(np.sum(1.0 - known.shares)) if known is not None else 0.0
    variance = noise_variance(engine.problem, residuals, float("inf"), used)
    problem = replace(engine.problem, scaling=replace(engine.problem.scaling, noise=math.sqrt(variance)))
    ridge = variance / known.spread**2 if known is not None and known.spread else 0.0
    return Penalised(context.choice.engine(problem, parameters), ridge, theta[: parameters.n_weights].copy()), variance


def _inwards(
    target: Penalised, theta: Array, place: int, bound: float, variance: float, threshold: float
) -> list[Array]:
    """The shared constants, in natural units, of fits with one of them (at `place`) further and further inside of its
    bound, as long as the deviance is below the threshold."""
    parameters = target.parameters
    learnable, maps = parameters.model.learnables[parameters.shared[place]], parameters.bijections(parameters.shared)
    column, least, found = parameters.n_weights + place, target.value(theta), []
    now = _inside(parameters, theta, np.array([place], dtype=np.int64))
    for share in WAY:
        moved = now.copy()
        moved[column] = Bijections.of((learnable,)).from_natural(
            np.array([Bijection.of(learnable).inside(bound, share)])
        )[0]
        try:
            rest = refitted(target, moved, (column,), variance)
        except (ComputationError, np.linalg.LinAlgError):
            break
        now = rest.theta
        if not 2 * (rest.objective - least) / variance <= threshold:
            break
        found.append(np.asarray(maps.to_natural(torch.from_numpy(now[parameters.places])).numpy()))
    return found


def refitted(target: Penalised, theta: Array, held: Sequence[int], variance: float) -> Rest:
    """The fit with entries held."""
    enough = 0.5 * ACCURACY * variance
    for _ in range(JACOBIANS):
        rest = minimise(target, Anchor(target.equations(theta), WEAK * variance, held), theta, enough, STEPS)
        theta = rest.theta
        if rest.promised <= enough:
            break
    return rest


def without_loosened(known: Certainty, parameters: Parameters) -> tuple[Certainty, list[str]]:
    """The certainty of a fit with disturbances without the deviations of constants that are tied to those at bounds,
    and what is to be said of them."""
    names = [parameters.model.learnables[i].name for i in parameters.shared]
    ended = [name for name, factor in zip(names, known.loosened, strict=False) if math.isnan(factor)]
    tied = {name: float(factor) for name, factor in zip(names, known.loosened, strict=False) if factor > TIED}
    kept = [math.nan if name in tied else sd for name, sd in zip(names, known.deviations, strict=True)]
    return replace(known, deviations=np.array(kept)), said_of_tied(tied, ended, HELPS)


def tied_to_bounds(engine: Engine, theta: Array, ended: list[str]) -> dict[str, float]:
    """How many times as large standard deviations would be if the constants that `ended` at bounds were free, by the
    names of the constants that are tied to these."""
    parameters = engine.parameters
    names = [parameters.model.learnables[i].name for i in parameters.shared]
    held = np.array([i for i, name in enumerate(names) if name in ended], dtype=np.int64)
    if not len(held) or len(held) == len(names):
        return {}
    factors = loosened(engine, _inside(parameters, theta, held), held)
    if factors is None:
        return {}
    return {name: float(factors[i]) for i, name in enumerate(names) if i not in held and factors[i] > TIED}


def _inside(parameters: Parameters, theta: Array, held: Integers) -> Array:
    """The vector with the constants `held` (places among the shared ones) off their bounds."""
    out, places = theta.copy(), parameters.n_weights + held
    each = tuple(parameters.model.learnables[parameters.shared[i]] for i in held)
    maps = Bijections.of(each)
    natural = maps.to_natural(torch.from_numpy(out[places])).numpy()
    moved = [Bijection.of(k).inside(float(value), INSIDE) for k, value in zip(each, natural, strict=True)]
    out[places] = maps.from_natural(np.array(moved))
    return out


def said_of_tied(tied: dict[str, float], ended: list[str], helps: str) -> list[str]:
    """A sentence for constants without an interval, with what `helps`."""
    if not tied:
        return []
    names, bounds = (" and ".join(f"`{name}`" for name in each) for each in (tied, ended))
    verb, their = ("has", "its") if len(tied) == 1 else ("have", "their")
    factor = max(tied.values())
    times = "over 1,000" if factor > 1000 else f"{factor:.2g}"
    them = "it" if len(ended) == 1 else "them"
    return [
        f"{names} {verb} no interval: the data tie {their} value to {bounds}, which ended at a bound; free of {them}, "
        f"{their} standard deviation would be {times} times as large. {helps}"
    ]
