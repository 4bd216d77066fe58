"""The limited-memory BFGS approximation of an inverse Hessian, from pairs of steps and changes of the gradient."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gbspec.arrays import Array

MEMORY = 20
"""Number of pairs of steps and gradient changes that are kept."""

Pair = tuple[Array, Array]
"""A step [n] and the change of the gradient [n] along it; their inner product is positive."""


def inverse_times(gradient: Array, pairs: Sequence[Pair], first: Callable[[Array], Array]) -> Array:
    """The approximate inverse Hessian times a gradient [n], by the two loops of Nocedal and Wright (algorithm 7.4).

    `pairs` come from the oldest to the newest; `first` applies the initial inverse Hessian.
    """
    rest, factors = gradient.copy(), []
    for moved, changed in reversed(pairs):
        factor = float(moved @ rest) / float(moved @ changed)
        rest -= factor * changed
        factors.append(factor)
    found = first(rest)
    for (moved, changed), factor in zip(pairs, reversed(factors), strict=True):
        found += (factor - float(changed @ found) / float(moved @ changed)) * moved
    return found


def of_newest_curvature(pairs: Sequence[Pair]) -> Callable[[Array], Array]:
    """The multiple of the identity with the newest pair's curvature; the identity if there is no pair."""
    if not pairs:
        return lambda vector: vector
    moved, changed = pairs[-1]
    scale = float(moved @ changed) / float(changed @ changed)
    return lambda vector: scale * vector
