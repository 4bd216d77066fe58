"""Starts in a steady state. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gbspec.backends.module.template.resting import _calmed
from gbspec.backends.module.template.vectors import _tensor

# <body>
# ---------------------------------------------------------------------- steady starts
# The solution is followed from the declared starts by linearly implicit steps that grow until nothing changes; Newton's
# method ends it. Linear sums that the equations conserve (rows L) keep the totals of the starts: the equations are
# f(x) + L'L (x - start) = 0, which has one solution near there, since L f = 0.


_RESTLESS = "the solution from the declared starts does not come to rest"


def _settled(
    slopes: Callable[[Any], Any], jacobians: Callable[[Any], Any], start: Any, laws: Any, rounding: float = 2.3e-16
) -> tuple[Any, dict[int, tuple[int, str]]]:
    """The steady states [P, s] reached from `start` [P, s], NaN where there is none, with the state and the reason.

    `rounding` is that of the slopes, relative.
    """
    close = max(1e-7, 100 * rounding)
    step: Any = None
    singular: Any = None
    x, failed = _followed(slopes, jacobians, np.array(start, dtype=np.float64), close)
    with np.errstate(all="ignore"):
        size = np.abs(x) + 1e-9 * np.abs(x).max(-1, initial=0.0)[:, None] + 1e-290
        tie = np.swapaxes(laws, 1, 2) @ laws
        for _ in range(12):
            jacobian = jacobians(x)
            weight = np.abs(jacobian).max((1, 2), initial=0.0)[:, None, None] * tie
            residual = slopes(x) + (weight @ (x - start)[:, :, None])[:, :, 0]
            step, singular = _solved(jacobian + weight, residual, size)
            x = np.where(np.isfinite(step), x - step, x)
            if not (np.abs(step) > 1e-14 * size).any():
                break
        wrong: Any = ~(np.abs(step) <= 10 * close * size).all(-1)
        # In what is conserved nothing has to come to rest.
        rates = np.linalg.eigvals(np.nan_to_num(jacobian - weight * tie))
        restless: Any = rates.real.max(-1) > -1e4 * rounding * np.abs(rates).max(-1)
        restless = restless & (slopes(np.array(start)) != 0).any(-1)  # who begins at rest stays there
        for row in np.flatnonzero(wrong | (singular >= 0) | restless):
            place = int(singular[row]) if singular[row] >= 0 else int(np.argmax(np.abs(step[row]) / size[row]))
            reason = "its Jacobian is singular" if singular[row] >= 0 else _RESTLESS
            failed.setdefault(int(row), (place, reason))
    x[list(failed)] = np.nan
    return x, failed


def _solved(matrix: Any, residual: Any, size: Any) -> tuple[Any, Any]:
    """Newton's step of each row, and the state that moves most where the matrix is singular (else -1)."""
    scale = np.abs(matrix * size[:, None, :]).max(-1, initial=0.0)[:, :, None]
    scaled = np.where(scale > 0, matrix * size[:, None, :] / np.where(scale > 0, scale, 1.0), 0.0)
    usable: Any = np.isfinite(scaled).all((1, 2))
    left, values, right = np.linalg.svd(np.where(usable[:, None, None], scaled, np.eye(len(size[0]))))
    singular = np.where(values[:, -1] < 1e-13 * values[:, 0], np.abs(right[:, -1]).argmax(-1), -1)
    right_side = (residual[:, :, None] / np.where(scale > 0, scale, 1.0))[:, :, 0]
    along = (np.swapaxes(left, 1, 2) @ right_side[:, :, None])[:, :, 0] / np.where(values > 0, values, np.inf)
    step = (np.swapaxes(right, 1, 2) @ along[:, :, None])[:, :, 0] * size
    return np.where(usable[:, None], step, np.nan), np.where(usable, singular, -1)


def _rates(jacobian: Any) -> tuple[Any, Any]:
    """The fastest growth of each row's solutions (0 without any), and the slowest change of all."""
    found = np.linalg.eigvals(np.nan_to_num(jacobian))
    sizes = np.abs(found)
    fastest = sizes.max(-1, initial=0.0)[:, None]
    moving = sizes > 1e-12 * fastest
    growth = np.where(moving, found.real, 0.0).max(-1, initial=0.0)
    return growth, np.where(moving, sizes, np.inf).min(-1, initial=np.inf)


def _divided(matrix: Any, vector: Any) -> Any:
    """The solutions of linear equations [P, s, s]; NaN for all where one of them has none."""
    try:
        return np.linalg.solve(matrix, vector[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return np.full(vector.shape, np.nan)


def _followed(slopes: Callable[[Any], Any], jacobians: Callable[[Any], Any], x: Any, close: float) -> tuple[Any, Any]:
    """States along which nothing changes any more, and the rows that do not come to rest."""
    count, n = x.shape
    largest = np.abs(x).max(-1, initial=0.0)[:, None]
    floor = np.maximum(1e-3 * np.abs(x), 1e-6 * np.where(largest > 0, largest, 1.0))
    with np.errstate(all="ignore"):
        h = 1e-2 / np.maximum((np.abs(slopes(x)) / (np.abs(x) + floor)).max(-1, initial=0.0), 1e-290)
        resting, eye, f, jacobian = np.zeros(count, dtype=bool), np.eye(n), slopes(x), jacobians(x)
        growth, slowest = _rates(jacobian)
        h = np.minimum(h, 0.2 / np.maximum(growth, 1e-290))
        for _ in range(600):
            matrix = np.nan_to_num(eye - h[:, None, None] * jacobian)
            step = _divided(matrix, h[:, None] * f)
            new = x + step
            ahead = slopes(new)
            error = _divided(matrix, np.nan_to_num(h[:, None] * ahead - step)) / 2
            size = np.maximum(np.abs(new), np.abs(x)) + floor
            share = (np.abs(error) / size).max(-1, initial=0.0)
            good = np.isfinite(share) & (share <= 0.02) & np.isfinite(new).all(-1) & ~resting
            still: Any = good & (np.abs(step) <= close * size).all(-1) & ((h * slowest > 1e3) | (step == 0).all(-1))
            x = np.where(good[:, None], new, x)
            resting |= still
            if resting.all():
                break
            h = h * np.where(good, np.clip(0.7 * np.sqrt(0.02 / np.maximum(share, 1e-12)), 0.3, 5.0), 0.25)
            h = np.where(resting, 1.0 / np.maximum(np.abs(jacobian).max((1, 2), initial=0.0), 1e-290), h)
            f, jacobian = np.where(good[:, None], ahead, f), jacobians(x)
            growth, slowest = _rates(jacobian)
            h = np.minimum(h, 0.2 / np.maximum(growth, 1e-290))  # an implicit step beyond would turn back
    moving = np.flatnonzero(~resting)
    return x, {int(i): (int((np.abs(f[i]) / (np.abs(x[i]) + floor[i])).argmax()), _RESTLESS) for i in moving}


def _torch_jacobian(function: Callable[[Any], Any], z: Any) -> Any:
    """Derivatives [P, s, s] of a function of rows [P, s], each row's by itself."""
    import torch

    with torch.enable_grad():
        at = z.detach().requires_grad_()
        f = function(at)
        found = [
            torch.autograd.grad(f[:, i].sum(), at, retain_graph=True, allow_unused=True)[0] if f.requires_grad else None
            for i in range(f.shape[1])
        ]
    return torch.stack([torch.zeros_like(z) if g is None else g for g in found], 1)


def _steady_start(
    equations: Any, m: Any, start: Any, condition: Any, inputs: Any, constants: Any, networks: Any, search: Any = None
) -> tuple[Any, dict[int, tuple[int, str]]]:
    """Starts [P, n] with steady states in place of the declared ones where the model starts so, torch, NaN where there
    is none.

    Differentiable (twice) by the implicit function theorem: two corrections with the fixed Jacobian of the solution.
    `search(run)` may keep what `run(networks)` finds with these networks: the solutions and failures.
    """
    import torch

    chosen = _tensor(equations.steady(m, condition, inputs, constants)[3], start).expand(len(start))
    rows = torch.nonzero(chosen.detach() > 0)[:, 0]
    some = len(rows) < len(start)
    given = start, condition, inputs
    if some:
        given = start[rows], condition[rows], inputs[rows]
        constants = tuple(value if value.ndim == 0 else value[rows] for value in constants)
    rest = _rested
    # [resting
    if any(not timed for _, timed, _ in getattr(equations, "events", ())):
        rest = _calmed
    # resting]
    found, failed = rest(equations, m, *given, constants, networks, search) if len(rows) else (start[rows], {})
    if hasattr(equations, "resumed"):
        found = equations.resumed(m, found, given[1], constants)
    if some:
        found = start.index_copy(0, rows, found)
    return found, {int(rows[row]): reason for row, reason in failed.items()}


def _rested(
    equations: Any, m: Any, start: Any, condition: Any, inputs: Any, constants: Any, networks: Any, search: Any
) -> tuple[Any, dict[int, tuple[int, str]]]:
    """The same of rows that all start so, and before states are set to other values."""
    import torch

    free = list(equations.steady_states)
    condition, inputs, rows, _ = equations.steady(m, condition, inputs, constants)
    time = _tensor(0.0, start)

    def slopes(z: Any, called: Any) -> Any:
        x = list(start.unbind(-1))
        for column, place in enumerate(free):
            x[place] = z[:, column]
        return equations.rhs(m, time, torch.stack(x, -1), condition, inputs, constants, called)[:, free]

    laws = [torch.stack([_tensor(c, start).expand(len(start)) for c in row], -1) for row in rows]
    tie = torch.stack(laws, 1) if laws else start.new_zeros((len(start), 0, len(free)))
    begun = start[:, free]

    def run(called: Any) -> Any:
        def numbers(z: Any) -> Any:
            with torch.no_grad():
                return slopes(_tensor(z, start), called).double().numpy(force=True)

        def jacobians(z: Any) -> Any:
            return _torch_jacobian(lambda at: slopes(at, called), _tensor(z, start)).double().numpy(force=True)

        given, sums = (part.detach().double().numpy(force=True) for part in (begun, tie))
        solution, failed = _settled(numbers, jacobians, given, sums, torch.finfo(start.dtype).eps)
        return solution, jacobians(np.nan_to_num(solution)), failed

    solution, jacobian, failed = run(networks) if search is None else search(run)
    z = _tensor(solution, start)
    matrix = _tensor(np.nan_to_num(jacobian), start)
    weight = matrix.abs().amax((1, 2))[:, None, None]
    matrix = matrix + weight * (tie.mT @ tie).detach()
    for row in failed:
        matrix[row] = torch.eye(len(free), dtype=start.dtype)
    for _ in range(2):
        residual = slopes(z, networks) + ((weight * (tie.mT @ tie)) @ (z - begun)[:, :, None])[:, :, 0]
        z = z - torch.linalg.solve(matrix, residual)
    out = list(start.unbind(-1))
    for column, place in enumerate(free):
        out[place] = z[:, column]
    return torch.stack(out, -1), failed


def _steady_starts(module: Any, start: Any, condition: Any, inputs: Any, constants: Any, networks: Any) -> Any:
    """The same for any batch [..., n]. Raises ArithmeticError where there is no steady state."""
    m = module.arithmetic("torch")
    if not module.states:
        return start
    shape = np.broadcast_shapes(
        start.shape[:-1], condition.shape[:-1], inputs.shape[:-1], *(value.shape for value in constants)
    )
    rows, given = int(np.prod(shape)), (start, condition, inputs)
    flat = [part.expand(*shape, part.shape[-1]).reshape(rows, part.shape[-1]) for part in given]
    own = tuple(value if value.ndim == 0 else value.expand(shape).reshape(rows) for value in constants)
    found, failed = _steady_start(module.equations, m, flat[0], flat[1], flat[2], own, networks)
    for row, (place, reason) in failed.items():
        name = module.states[module.equations.steady_states[place]]
        raise ArithmeticError(f"there is no steady start of `{name}` in row {row}: {reason}")
    return found.reshape(*shape, found.shape[-1])


# [resting
def _followed_start(module: Any, start: Any, condition: Any, inputs: Any, constants: Any) -> Any:
    """What `_steady_start` returns, of one start [n] in double precision, in arrays."""
    import torch

    like = torch.zeros((), dtype=torch.float64)
    known = {name: _tensor(value, like) for name, value in module.weights.items()}
    x, c, u = (_tensor(value, like)[None] for value in (start, condition, inputs))
    m, own = module.arithmetic("torch"), _tensor(constants, like).unbind()
    with torch.no_grad():
        found, failed = _steady_start(module.equations, m, x, c, u, own, module.torch_networks(known))
    return found[0].numpy(force=True), failed


# resting]
