"""Steady states: damped Newton and pseudo-transient continuation from many initial guesses, with exact Jacobians.

Half of the guesses take Newton steps whose length is limited to a part of the box; they find saddles and unstable foci
as readily as stable points. The other half follow the flow with growing implicit Euler steps (pseudo-transient
continuation: Kelley and Keyes, SIAM J. Numer. Anal. 35, 1998), which find attractors. All guesses run as one batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbspec.analysis.systems.points import quasirandom_points
from gbspec.analysis.systems.system import System, require_autonomous
from gbspec.arrays import Array, ComplexArray

Linear = Callable[[Array], tuple[Array, Array]]
"""States [N, n] -> right-hand sides [N, n] and Jacobians [N, n, n]."""

CONVERGED = 1e-9
"""A steady state is accepted if Newton's next step is below this fraction of the states' scale."""
DISTINCT = 1e-6
"""Steady states closer than this fraction of the scale count as one."""


@dataclass(frozen=True)
class SteadyState:
    """One steady state [n], the norm of the right-hand side, and the Jacobian's eigenvalues by decreasing real part.

    `outside` names the states, conditions and inputs outside their trained (else plausible) ranges.
    """

    state: Array
    rhs_norm: float
    eigenvalues: ComplexArray
    outside: tuple[str, ...] = ()

    @property
    def stable(self) -> bool:
        """Whether all eigenvalues are in the left half plane."""
        return bool(np.all(self.eigenvalues.real < -axis_width(self.eigenvalues)))


def axis_width(eigenvalues: ComplexArray) -> float:
    """The size of real parts that are rounding: eigenvalues with such a real part lie on the imaginary axis."""
    return 1e-13 * float(np.max(np.abs(eigenvalues), initial=0.0))


def batch_solve(matrices: Array, right: Array) -> Array:
    """Solves [N, n, n] systems for right sides [N, n]; a singular or infinite system gives NaN in its row."""
    try:
        return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0])
    except np.linalg.LinAlgError:
        rows = np.full(right.shape, np.nan)
        for i, (matrix, vector) in enumerate(zip(matrices, right, strict=True)):
            try:
                rows[i] = np.linalg.solve(matrix, vector)
            except np.linalg.LinAlgError:
                continue
        return rows


def _newton(linear: Linear, x: Array, scale: Array, iterations: int, longest: float) -> Array:
    """Takes Newton steps, each limited to the fraction `longest` of the scale in every state."""
    for _ in range(iterations):
        f, jacobian = linear(x)
        step = -batch_solve(jacobian, f)
        reach = np.max(np.abs(step / scale), axis=1, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            x = x + step * np.minimum(1.0, longest / reach)
        if np.nanmax(reach, initial=0.0) < CONVERGED:
            break
    return x


def _pseudo_transient(linear: Linear, x: Array, scale: Array, iterations: int) -> Array:
    """Takes implicit Euler steps that grow as the right-hand side shrinks (switched evolution relaxation)."""
    f, jacobian = linear(x)
    size = np.linalg.norm(f / scale, axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        step = 0.1 / np.maximum(size, 1e-12)
        for _ in range(iterations):
            x = x + batch_solve(np.eye(x.shape[1]) / step[:, None, None] - jacobian, f)
            f, jacobian = linear(x)
            new = np.linalg.norm(f / scale, axis=1)
            step = np.minimum(step * np.clip(size / new, 0.3, 10.0), 1e12)
            size = new
    return x


def find_zeros(linear: Linear, starts: Array, scale: Array) -> Array:
    """The distinct zeros [M, n] of a right-hand side found from guesses [N, n], each verified by Newton's next step."""
    half = len(starts) // 2
    with np.errstate(all="ignore"):
        candidates = _newton(linear, starts[half:], scale, 60, 0.2)
        if half:
            settled = _newton(linear, _pseudo_transient(linear, starts[:half], scale, 40), scale, 20, 0.2)
            candidates = np.concatenate([candidates, settled])
        candidates = candidates[np.isfinite(candidates).all(axis=1)]
        if not len(candidates):
            return np.empty((0, starts.shape[1]))
        candidates = _newton(linear, candidates, scale, 4, 1.0)
        f, jacobian = linear(candidates)
        error = np.max(np.abs(batch_solve(jacobian, f) / scale), axis=1)
        finite = np.isfinite(candidates).all(axis=1) & np.isfinite(f).all(axis=1)
    return distinct(candidates[finite & (error < CONVERGED)], scale)


def distinct(points: Array, scale: Array) -> Array:
    """The points [M, n] that differ by more than `DISTINCT` of the scale, in lexicographic order."""
    kept: list[Array] = []
    for point in points:
        if all(np.max(np.abs((point - other) / scale)) > DISTINCT for other in kept):
            kept.append(point)
    kept.sort(key=lambda point: tuple(np.round(point / scale, 9)))
    return np.array(kept).reshape(len(kept), points.shape[1])


def start_points(system: System, count: int, seed: int = 0, extra: Array | None = None) -> Array:
    """Guesses [N, n] distributed over the box of initial states, and `extra` ones (data, other branches)."""
    low, high = system.start_box
    points = low + (high - low) * quasirandom_points(count, system.size, seed)
    return points if extra is None or not len(extra) else np.concatenate([points, extra])


def steady_states(
    system: System, *, starts: int = 64, seed: int = 0, extra: Array | None = None
) -> tuple[SteadyState, ...]:
    """The steady states found from many guesses, with all parameters at the system's values.

    States below a declared lower bound that is zero or more (negative concentrations) are omitted. Raises UserError
    (GB871, GB873) if a number is missing or the system depends on time.
    """
    require_autonomous(system, "steady states")
    fixed = (system.vector(system.conditions), system.vector(system.inputs), system.vector(system.constants))

    def linear(x: Array) -> tuple[Array, Array]:
        f, jacobian = system.linearised.many([system.time], x, *fixed)
        return f, jacobian.reshape(-1, system.size, system.size)

    zeros = find_zeros(linear, start_points(system, starts, seed, extra), system.scale)
    return tuple(describe(system, x) for x in zeros if system.admissible(x))


def describe(system: System, x: Array) -> SteadyState:
    """A state with its residual and eigenvalues."""
    f, _ = system.linearise(x)
    return SteadyState(x, float(np.linalg.norm(f)), system.spectrum(x), system.outside(x))
