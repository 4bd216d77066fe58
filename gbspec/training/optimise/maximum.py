"""The maximum of the likelihood near a fit whose sizes of disturbances and noises are those of the restricted one.

Criteria and ratios of likelihoods are of maxima. The restricted sizes are larger than the likeliest ones, the more the
more constants were estimated, so that -2 log likelihood at them is above its minimum by about p^2/(2n).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.optimise.priors import Priors
from gbspec.training.optimise.restricted import FLAT, LEAST, inverse
from gbspec.training.problem import Integers

STEPS, LONGEST = 30, 0.7
"""Scoring steps, and how far an entry moves in one."""
FIRST, STRONGER, DAMPINGS = 1e-3, 8.0, 8
"""The first damping of steps, the factor of stronger ones, and how many are tried."""
ENOUGH = 1e-4
"""Steps end where the next promises less of the log likelihood."""
GROWS = 0.5
"""The likelihood grows without end as a noise goes to zero where its slope there is that of more than half a value that
the model has exactly."""


@dataclass(frozen=True)
class Likeliest:
    """A vector [size] with the filter there, its negative log likelihood with the priors of constants, and by how much
    a next step would lower it, at least before the last one; infinite where none was computed."""

    vector: Array
    found: Filtered
    value: float
    promised: float = float("inf")

    @property
    def compared(self) -> float:
        """The value as one of several; infinite where there is no solution."""
        return self.value if np.isfinite(self.value) else float("inf")


def likeliest(
    engine: FilterEngine, vector: Array, found: Filtered | None = None, held: int | None = None, steps: int = STEPS
) -> Likeliest:
    """The maximum of the likelihood, with the priors of constants, near a vector; `found` is the filter there. Weights
    of networks stay, as does the entry that is `held`, and what is at a bound. With fewer `steps` it is on its way."""
    parameters, least = engine.parameters, engine.noise.least()
    priors = _priors(engine)
    start = engine.filtered(vector) if found is None else found
    now = Likeliest(vector, start, start.value + priors.penalty(vector[: parameters.size]))
    damping, promised = FIRST, float("inf")
    for _ in range(steps if start.finite else 0):
        gradient, matrix = _with_priors(engine, priors, now)
        moving = np.where(np.diag(matrix) > 10 * FLAT, engine.layout.free, 0.0)
        moving[: parameters.n_weights] = 0.0
        if held is not None:
            moving[held] = 0.0
        undamped = inverse(matrix, moving, LEAST) @ gradient
        promised = 0.5 * float(undamped @ gradient)
        if not promised > ENOUGH:
            break
        for _ in range(DAMPINGS):
            damped = matrix + damping * np.diag(np.diag(matrix))
            trial = now.vector - np.clip(inverse(damped, moving, LEAST) @ gradient, -LONGEST, LONGEST)
            trial[parameters.size :] = np.maximum(trial[parameters.size :], least)
            there = engine.filtered(trial, guess=now.found.guess)
            value = there.value + priors.penalty(trial[: parameters.size])
            if value < now.value:
                break
            damping = max(damping * STRONGER, FIRST)
        else:
            break
        now, damping = Likeliest(trial, there, value), damping / STRONGER
    return replace(now, promised=promised)


def restricted_value(engine: FilterEngine, point: Likeliest, others: Integers) -> float:
    """The negative logarithm of the restricted likelihood at a maximum with sizes held, with `others` integrated out in
    Laplace's approximation, but for a constant; infinite where there is none."""
    if not point.found.finite:
        return float("inf")
    _, matrix = _with_priors(engine, _priors(engine), point)
    sign, logarithm = np.linalg.slogdet(matrix[np.ix_(others, others)])
    return point.value + 0.5 * float(logarithm) if sign > 0 or not len(others) else float("inf")


def information_with_priors(engine: FilterEngine, vector: Array) -> Array:
    """The expected information [size, size] at a vector, with that of the priors of constants."""
    found = engine.filtered(vector)
    return _with_priors(engine, _priors(engine), Likeliest(vector, found, found.value))[1]


def _priors(engine: FilterEngine) -> Priors:
    return Priors.of_likelihood(engine.problem, engine.parameters)


def _with_priors(engine: FilterEngine, priors: Priors, now: Likeliest) -> tuple[Array, Array]:
    """Gradient and information at a point, with those of the priors of constants."""
    information, size = engine.information(now.vector, now.found), engine.parameters.size
    matrix, gradient = information.matrix.copy(), information.gradient.copy()
    if len(priors):
        gradient[:size] += priors.gradient(now.vector[:size])
        np.add.at(matrix, (priors.column, priors.column), priors.slopes(now.vector[:size]) ** 2)
    return gradient, matrix


@dataclass(frozen=True)
class Maximum:
    """The negative log likelihood at its maximum near a fit; None where that is not known, or where there is none: it
    falls without end as the noise of the channels `unbounded` goes to zero."""

    value: float | None
    unbounded: tuple[int, ...] = ()


def at_maximum(engine: FilterEngine, vector: Array, found: Filtered) -> Maximum:
    """The maximum of the likelihood near a fit; it is not known with priors, which weights of networks have too: the
    fit is not where the likelihood alone has its maximum."""
    parameters = engine.parameters
    if parameters.n_weights or len(_priors(engine)):
        return Maximum(None)
    near = likeliest(engine, vector, found)
    rising = np.flatnonzero(_by_noise(engine, near) > GROWS)
    unbounded = [int(engine.noise.learned[place]) for place in rising if _grows(engine, near, int(place))]
    return Maximum(None if unbounded else near.value, tuple(unbounded))


def _by_noise(engine: FilterEngine, point: Likeliest) -> Array:
    """The derivatives of the negative log likelihood in the logarithms of learned noises. At a maximum they are zero;
    the variance of a value that the model has exactly is that of its noise, which adds 1."""
    if not point.found.finite:
        return np.zeros(engine.layout.noises)
    return engine.information(point.vector, point.found).gradient[engine.parameters.size :]


def _grows(engine: FilterEngine, near: Likeliest, place: int) -> bool:
    """Whether the likelihood is higher with a learned noise at its least value, all else refitted, and still grows as
    the noise falls."""
    vector, entry = near.vector.copy(), engine.parameters.size + place
    vector[entry] = engine.noise.least()[place]
    point = likeliest(engine, vector, held=entry)
    return point.value <= near.value + ENOUGH and bool(_by_noise(engine, point)[place] > GROWS)


__all__ = ["Likeliest", "Maximum", "at_maximum", "information_with_priors", "likeliest", "restricted_value"]
