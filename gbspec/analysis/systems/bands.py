"""Bands of learned functions: where, with 90 % probability, the true one lies at each point.

A member's band is that of its linearised fit (delta method): sqrt(g^T C g), with g the derivative of the function's
value, contracts included, with respect to its weights and constants, and C their covariance (`gbspec.runs.Covariance`).
The variance between members is added, as in the intervals of constants.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array

if TYPE_CHECKING:
    from gbspec.backends import GeneratedModule
    from gbspec.ir import Model
    from gbspec.runs import Covariance, Run

CHUNK = 256
"""Points whose derivatives are held at the same time."""


def function_bands(run: Run, name: str, points: Array) -> tuple[Array, Array, Array]:
    """The mean over members of an unknown at `points` [P, n_arguments], and the lower and upper end of its 90 % band,
    each [P]; the ends are NaN where a member's covariance is not known (an older run, an interrupted fit)."""
    from gbspec.backends import Evaluator

    points = np.atleast_2d(np.asarray(points, dtype=np.float64))
    values = np.stack([Evaluator(member).functions_many(name, points) for member in run.members])
    between = values.var(axis=0, ddof=1) if len(values) > 1 else 0.0
    within = np.mean([_deviations(run, number, name, points) ** 2 for number in run.numbers], axis=0)
    mean, half = values.mean(axis=0), run.fit.quantile * np.sqrt(within + between)
    low, high = _guaranteed(run.model, name)
    return mean, np.minimum(np.maximum(mean - half, low), mean), np.maximum(np.minimum(mean + half, high), mean)


def _guaranteed(model: Model, name: str) -> tuple[float, float]:
    """The numbers between which an unknown's contracts keep it; infinite where there is none."""
    (unknown,) = (one for one in model.unknowns if one.name == name)
    ends = {"lower": -np.inf, "upper": np.inf}
    for contract in unknown.contracts:
        if contract.kind in ends and contract.value is not None and contract.value.is_number:
            ends[contract.kind] = float(contract.value)
    return ends["lower"], ends["upper"]


def _deviations(run: Run, number: int, name: str, points: Array) -> Array:
    """The standard deviations [P] of one member's function; NaN if not known."""
    known = run.certainties(number).covariance
    if known is None:
        return np.full(len(points), np.nan)
    parts = [points[start : start + CHUNK] for start in range(0, len(points), CHUNK)]
    found = [known.deviations(*_derivatives(run.member(number), known, name, part)) for part in parts]
    return np.concatenate([np.zeros(0), *found])


def _derivatives(member: GeneratedModule, known: Covariance, name: str, points: Array) -> tuple[Array, Array]:
    """Derivatives of a function's values [P, n] with respect to all weights, and [P, k] to the shared constants."""
    slopes = member.function_slopes(name, points)
    shapes = member.shapes()
    weights = [
        slopes[key].reshape(len(points), -1) if key in slopes else np.zeros((len(points), int(np.prod(shapes[key]))))
        for key in known.names
    ]
    constants = slopes["constants"][:, [member.constants.index(constant) for constant in known.constants]]
    return np.concatenate([np.zeros((len(points), 0)), *weights], axis=1), constants
