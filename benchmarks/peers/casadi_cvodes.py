"""CasADi's interface to CVODES (BDF of variable order), one call for each trajectory.

Gradients are those of the library, by adjoint or forward sensitivities. Right-hand sides and Jacobians are evaluated by
CasADi's virtual machine, as its users get it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import casadi as ca
import numpy as np

from benchmarks.stiff_workload import StiffWork

Sensitivities = Literal["adjoint", "forward"]
MOST_STEPS = 100_000
"""The largest number of steps between two rows."""


def parameters(work: StiffWork) -> np.ndarray[Any, Any]:
    """Weights and logarithms of rates, in the order of `StiffWork.natural`."""
    weights = [part.ravel() for layer in work.layers for part in layer]
    return np.concatenate([*weights, np.log(work.rates)])


def right_hand_side(work: StiffWork, z: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of change of the scaled states [3]; the scale is that of the tolerances."""
    y1, y2, y3 = (z[i] * work.scale[i] for i in range(3))
    place = 0
    inner = ca.vertcat(y2, y3) / work.input_scale if work.layers else None
    for i, (weight, _) in enumerate(work.layers):
        rows, columns = weight.shape
        w = ca.reshape(p[place : place + weight.size], columns, rows).T
        b = p[place + weight.size : place + weight.size + rows]
        place += weight.size + rows
        inner = w @ inner + b
        if i < len(work.layers) - 1:
            inner = inner / (1 + ca.exp(-inner))
    k = ca.exp(p[place:])
    if work.layers:
        y, width = ca.vertcat(y2, y3), work.input_scale
        zeros = y / ca.sqrt(y**2 + width**2)
        fast = zeros[0] * zeros[1] * (work.output_center + work.output_scale * inner[0])
    else:
        fast = k[2] * y2 * y3
    slow, very_fast = k[0] * y1, k[1] * y2**2
    return ca.vertcat(fast - slow, slow - very_fast - fast, very_fast) / work.scale


class Peer:
    """States, and loss with gradient, by adjoint or forward sensitivities, which are under the tolerance too."""

    def __init__(self, work: StiffWork, kind: Sensitivities) -> None:
        self._work, self._kind, self._p = work, kind, parameters(work)
        self._made: dict[float, tuple[ca.Function, ca.Function]] = {}

    def _functions(self, rtol: float) -> tuple[ca.Function, ca.Function]:
        """The solver (z0, p) -> states [3, T], and (start, p, value, weight) -> loss and its gradient by (p, start)."""
        if rtol in self._made:
            return self._made[rtol]
        work = self._work
        z, p = ca.SX.sym("z", 3), ca.SX.sym("p", self._p.size)
        dae = {"x": z, "p": p, "ode": right_hand_side(work, z, p)}
        options = {
            "reltol": rtol,
            "abstol": work.floor * rtol,
            "max_num_steps": MOST_STEPS,
            "fsens_err_con": True,
            "enable_forward": self._kind == "forward",
            "enable_reverse": self._kind == "adjoint",
            "print_stats": False,
            "show_eval_warnings": False,
        }
        solver = ca.integrator("solver", "cvodes", dae, 0.0, list(work.times), options)
        start, q = ca.MX.sym("start", 3), ca.MX.sym("q", self._p.size)
        value, weight = (ca.MX.sym(name, 3, len(work.times)) for name in ("value", "weight"))
        found = ca.diag(ca.DM(work.scale)) @ solver(x0=start / work.scale, p=q)["xf"]
        loss, by = ca.sumsqr(ca.sqrt(weight) * (found - value)), ca.vertcat(q, start)
        if self._kind == "adjoint":
            gradient = ca.gradient(loss, by)
        else:
            gradient = ca.jtimes(loss, by, ca.MX.eye(by.numel())).T
        self._made[rtol] = (
            ca.Function("states", [start, q], [found]),
            ca.Function("loss", [start, q, value, weight], [loss, gradient]),
        )
        return self._made[rtol]

    def states(self, rtol: float) -> tuple[np.ndarray[Any, Any], float]:
        """States [N, T, 3], and NaN: the library does not tell the steps of functions that contain a solver."""
        solve, _ = self._functions(rtol)
        try:
            found = np.array([np.array(solve(start, self._p)).T for start in self._work.start])
        except RuntimeError:
            return np.full_like(self._work.value, np.inf), float("nan")
        return found, float("nan")

    def step(self, rtol: float) -> Callable[[], tuple[float, np.ndarray[Any, Any]]]:
        """Loss and gradient, in the order of `StiffWork.natural`, as a call without arguments."""
        work, (_, both) = self._work, self._functions(rtol)

        def call() -> tuple[float, np.ndarray[Any, Any]]:
            total, shared, starts = 0.0, np.zeros(self._p.size), []
            for start, value, weight in zip(work.start, work.value, work.weight, strict=True):
                loss, gradient = both(start, self._p, value.T, weight.T)
                flat = np.array(gradient).ravel()
                total, shared = total + float(loss), shared + flat[:-3]
                starts.append(flat[-3:])
            return total, np.concatenate([shared, *starts])

        return call
