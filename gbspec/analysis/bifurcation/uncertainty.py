"""Intervals of folds and Hopf points from one fit: the covariance of its weights and constants, linearised.

A point (x, p) solves f = 0 and one further equation, and moves with every parameter w of f (implicit function theorem).
Multiplied by vectors that remove the change of x, both kinds have the form dp/dw = -(N_w / N_p):

    fold    N = psi f,                psi the left null vector of the Jacobian A
    Hopf    N = h - y f,              h = Re <p, A q>, p and q of `critical_pair`, A^T y = dh/dx

Both need derivatives of directions times f with respect to w alone, which the generated module gives. A branch point
exists only as long as nothing perturbs the model, and has no interval.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.bifurcation.continuation import SpecialPoint
from gbspec.analysis.bifurcation.diagram import Diagram
from gbspec.analysis.bifurcation.hopf import critical_pair
from gbspec.analysis.systems import Family, System
from gbspec.arrays import Array
from gbspec.runs import NORMAL_90

if TYPE_CHECKING:
    from gbspec.backends import GeneratedModule
    from gbspec.runs import Covariance

STEP = 1e-4
"""The step of central differences in direction q, and of p, relative to the widths of states and parameter."""


@dataclass(frozen=True)
class Certainty:
    """What is known of a member's parameters: the `covariance`, and the constants `given` by the user, which have no
    uncertainty."""

    member: GeneratedModule
    covariance: Covariance
    given: Collection[str] = ()


def with_uncertainty(diagram: Diagram, system: System, certainty: Certainty) -> Diagram:
    """The diagram of a member with the standard deviation and the 90 % interval of each fold and Hopf point."""
    family = Family(system, diagram.parameter)
    width = diagram.high - diagram.low
    return replace(diagram, special=tuple(_known(point, family, width, certainty) for point in diagram.special))


def _known(point: SpecialPoint, family: Family, width: float, certainty: Certainty) -> SpecialPoint:
    if point.kind not in ("fold", "hopf"):
        return point
    slopes = point_slopes(point, family, width, certainty.member)
    covariance, size = certainty.covariance, certainty.covariance.vectors.shape[1]
    weights = np.concatenate([np.zeros(0), *(slopes[name].ravel() for name in covariance.names)])
    index = certainty.member.constants.index
    fixed = {family.name, *certainty.given}
    constants = [0.0 if name in fixed else float(slopes["constants"][index(name)]) for name in covariance.constants]
    sd = float(covariance.deviations(weights.reshape(1, size), np.array([constants]))[0])
    if not np.isfinite(sd):
        return point
    return replace(point, sd=sd, interval=(point.value - NORMAL_90 * sd, point.value + NORMAL_90 * sd))


def point_slopes(point: SpecialPoint, family: Family, width: float, member: GeneratedModule) -> dict[str, Array]:
    """The derivative of a point's parameter with respect to the member's weights and constants, by name."""
    n, state, value = family.size, point.state, point.value
    _, jacobian, of_parameter = family.linear(state, value)
    jacobian = jacobian.reshape(n, n)
    if point.kind == "fold":
        psi = np.linalg.svd(jacobian)[0][:, -1]
        return _scaled(_slopes(family, member, value, state[None], psi[None]), np.ones(1), float(psi @ of_parameter))
    _, q, p = critical_pair(jacobian)
    pairs = ((p.real, q.real), (p.imag, q.imag))
    unit = np.eye(n)
    along = np.array([sum(a @ family.bilinear(state, value, b, e)[0] for a, b in pairs) for e in unit])
    step = STEP * width
    ahead, behind = (
        sum(a @ family.linear(state, value + sign * step)[1].reshape(n, n) @ b for a, b in pairs) for sign in (1, -1)
    )
    y = np.linalg.solve(jacobian.T, along)
    denominator = (ahead - behind) / (2 * step) - y @ of_parameter
    reach = STEP * float(np.min(family.system.scale / np.maximum(np.abs(q), 1e-12)))
    places = [state + sign * reach * b for _, b in pairs for sign in (1, -1)]
    directions = [a for a, _ in pairs for _ in (1, -1)]
    factors = np.array([0.5, -0.5, 0.5, -0.5, -reach]) / reach
    found = _slopes(family, member, value, np.array([*places, state]), np.array([*directions, y]))
    return _scaled(found, factors, float(denominator))


def _slopes(family: Family, member: GeneratedModule, value: float, x: Array, by: Array) -> dict[str, Array]:
    """Derivatives of `by` times f, both [P, n], with respect to weights and constants: arrays [P, ...]."""
    system = family.at(value)
    conditions, inputs, constants = (
        system.vector(names) for names in (system.conditions, system.inputs, system.constants)
    )
    return member.rhs_slopes(x, by, system.time, conditions, inputs, constants)


def _scaled(slopes: Mapping[str, Array], factors: Array, denominator: float) -> dict[str, Array]:
    """Minus the sum of the points' slopes times `factors` [P], over the denominator; infinite where that is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return {name: -np.tensordot(factors, found, axes=1) / denominator for name, found in slopes.items()}
