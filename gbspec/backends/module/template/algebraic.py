"""Algebraic variables. Only modules of models with any have them, without everything above the line `# <body>`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gbspec.backends.module.template.arithmetic import _numpy_arithmetic

# <body>
# ---------------------------------------------------------------------- algebraic variables
# `equations.blocks` has for each block of equations the method that gives its residuals, that which gives their
# derivatives as well (empty with unknown functions in them), the names of its equations, and name, start, lower and
# upper end of each of its variables. Newton's method finds them from their starts, damped so that residuals fall and
# nothing leaves the range. The solution is found without derivatives; corrections with its
# Jacobian as a constant, of which each adds an order, then give it those of the implicit function, and round it off.

_TICKS = 60  # most evaluations of a block's residuals and their derivatives
_LEAST = 1e-8  # a smaller change, in sizes of the variables, is not tried
_ENOUGH = 1e-4  # of the fall of residuals that Newton's step promises
_INSIDE = 0.9  # of the way to an end of the range


def _solved(equations: Any, math: Any, given: Any) -> Any:
    """The algebraic variables in the order of the blocks, NaN where there is no solution; `given`: time, state,
    condition, inputs, constants and networks."""
    found: tuple[Any, ...] = ()
    for block in equations.blocks:
        found = (*found, *math.unpack(_root(given[1])(equations, block, math, given, found)))
    return math.pack(given[1], found)


def _root(state: Any) -> Any:
    """The function that solves for a block's variables in the library of a state."""
    library = type(state).__module__.split(".")[0]
    return {"torch": _torch_root, "casadi": _casadi_root}.get(library, _numpy_root)


def _unsolved(equations: Any, math: Any, given: Any) -> str:
    """Which equations have no solution at a single point, and the residuals where the search ended; numpy or torch."""
    found: tuple[Any, ...] = ()
    for block in equations.blocks:
        method, _, names, variables = block
        solved = _root(given[1])(equations, block, math, given, found)
        if all(abs(value) < np.inf for value in solved.tolist()):
            found = (*found, *math.unpack(solved))
            continue
        last = _root(given[1])(equations, block, math, given, found, True)
        left = getattr(equations, method)(math, *given, (*found, *math.unpack(last))).tolist()
        ends = ", ".join(f"`{v[0]}` = {z:.6g}" for v, z in zip(variables, last.tolist(), strict=True))
        which = ", ".join(f"`{name}` (residual {r:.3g})" for name, r in zip(names, left, strict=True))
        word = "equations" if len(names) > 1 else "equation"
        return f"no solution of the {word} {which} was found: the search ended at {ends}"
    return ""


def _newton(lib: Any, linear: Callable[[Any], Any], divide: Callable[[Any, Any], Any], start: Any, ends: Any) -> Any:
    """Solutions of a batch [..., n], NaN where none was found; derivatives [..., n, n] there; and the last points.

    `linear`: residuals and their derivatives at points; `divide`: solves linear equations; `ends`: of the ranges, and
    sizes of the variables.
    """
    low, high, scale = ends
    tolerance = lib.finfo(start.dtype).eps ** 0.45
    z = trial = start
    g, slopes = linear(start)
    taken = (start == start).all(-1)
    size, merit, done = 0.0 * g[..., 0] + 1.0, 0.0 * g[..., 0], ~taken
    step = weights = g
    for _ in range(_TICKS):
        z = lib.where(taken[..., None], trial, z)
        fall = divide(slopes, g)
        step = lib.where(taken[..., None], -fall, step)
        sizes = (lib.abs(slopes) * scale).sum(-1)
        weights = lib.where(taken[..., None], 1.0 / lib.where(sizes > 0, sizes, 1.0 + 0.0 * sizes), weights)
        merit = lib.where(taken, lib.amax(lib.abs(g) * weights, -1), merit)
        done = done | (taken & (lib.amax(lib.abs(step) / (lib.abs(z) + scale), -1) <= tolerance))
        room = lib.where(step > 0, high - z, z - low) / (lib.abs(step) + 1e-300)
        room = lib.amin(room, -1)
        longest = lib.where(room >= 1.0, 1.0 + 0.0 * room, _INSIDE * room)
        size = lib.where(taken, longest, 0.5 * size)
        if (done | ~(size * lib.amax(lib.abs(step) / scale, -1) >= _LEAST)).all():
            break
        trial = lib.where(done[..., None], z, z + size[..., None] * step)
        new, its = linear(trial)
        taken = (lib.amax(lib.abs(new) * weights, -1) <= (1.0 - _ENOUGH * size) * merit) & ~done
        g = lib.where(taken[..., None], new, g)
        slopes = lib.where(taken[..., None, None], its, slopes)
    return lib.where(done[..., None], z, np.nan + 0.0 * z), slopes, z


def _torch_root(equations: Any, block: Any, math: Any, given: Any, known: Any, last: bool = False) -> Any:
    """A block's variables [..., n]; with `last` the points at which the search ended."""
    import torch

    residual, state = getattr(equations, block[0]), given[1]
    exact = bool(block[1]) or (state.dtype == torch.float64 and state.device.type == "cpu")
    found, slopes, point = (_numpy_search_of if exact else _torch_search)(equations, block, math, given, known)
    if last or not torch.is_grad_enabled():
        return point if last else found
    for _ in range(2):
        found = found - _torch_divided(slopes, residual(math, *given, (*known, *found.unbind(-1))))
    return found.to(state.dtype)


def _torch_divided(slopes: Any, g: Any) -> Any:
    import torch

    return g / slopes[..., 0] if g.shape[-1] == 1 else torch.linalg.solve_ex(slopes, g.unsqueeze(-1))[0].squeeze(-1)


def _torch_search(equations: Any, block: Any, math: Any, given: Any, known: Any) -> Any:
    """As from `_newton`, with derivatives by torch; for equations with unknown functions in single precision, or on
    another device."""
    import torch
    from torch import Tensor

    t, state, condition, inputs, constants, networks = given
    residual = getattr(equations, block[0])
    # What records the calls of networks has to see those of the corrections alone.
    quiet = tuple(getattr(network, "quiet", network) for network in networks)
    start, low, high = (state.new_tensor([v[i] for v in block[3]]) for i in range(1, 4))
    fixed = tuple(k.detach() if isinstance(k, Tensor) else k for k in constants)
    fixed_known = tuple(value.detach() for value in known)

    def left(z: Any) -> Any:
        return residual(math, t, state.detach(), condition, inputs, fixed, quiet, (*fixed_known, *z.unbind(-1)))

    def linear(z: Any) -> Any:
        with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(lambda x: x, lambda x: x):
            at = z.detach().requires_grad_()
            g = left(at) + 0.0 * at  # which depends on the variables even where the residuals do not
            rows = [torch.autograd.grad(row.sum(), at, retain_graph=True)[0] for row in g.unbind(-1)]
        return g.detach(), torch.stack(rows, -2)

    with torch.no_grad():
        shape = left(start.expand(*state.shape[:-1], -1)).shape
        ends = (low, high, _sizes(low, high, start))
        found, slopes, point = _newton(torch, linear, _torch_divided, start.expand(shape), ends)
        for _ in range(2):
            found = found - _torch_divided(slopes, left(found))
    return found, slopes, point


def _numpy_search_of(equations: Any, block: Any, math: Any, given: Any, known: Any) -> Any:
    """The search over arrays, several times as fast as that over tensors; its result as tensors."""
    import torch

    networks = () if block[1] else tuple(_PlainNetwork(getattr(one, "quiet", one)) for one in given[5])
    found = _numpy_search(equations, block, _numpy_arithmetic(), (*map(_plain, given[:5]), networks), _plain(known))
    state = given[1]
    return tuple(torch.as_tensor(part, dtype=state.dtype, device=state.device) for part in found)


def _plain(value: Any) -> Any:
    """Tensors, also in tuples, as arrays in double precision."""
    if isinstance(value, tuple):
        return tuple(map(_plain, value))
    return value.detach().cpu().double().numpy() if hasattr(value, "detach") else value


class _PlainNetwork:
    """A network of tensors over arrays, with its scales."""

    def __init__(self, network: Any) -> None:
        self.network = network

    def __getattr__(self, name: str) -> Any:
        return _plain(getattr(self.network, name))

    def __call__(self, *arguments: Any) -> Any:
        import torch

        with torch.no_grad():
            return _plain(self.network(*map(torch.tensor, arguments)))


def _sizes(low: Any, high: Any, start: Any) -> Any:
    """The sizes of variables: the lengths of their ranges, else their starts, else 1."""
    sizes = abs(start) + 1.0 * (start == 0)
    for i, (a, b) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        if abs(a) < np.inf and abs(b) < np.inf:
            sizes[i] = b - a
    return sizes


def _numpy_root(equations: Any, block: Any, math: Any, given: Any, known: Any, last: bool = False) -> Any:
    """A block's variables [..., n]; with `last` the points at which the search ended."""
    found, slopes, point = _numpy_search(equations, block, math, given, known)
    if last:
        return point
    with np.errstate(all="ignore"):  # what records the calls of networks sees this one
        left = getattr(equations, block[0])(math, *given, (*known, *np.moveaxis(found, -1, 0)))
        return found - _numpy_divided(slopes, left)


def _numpy_divided(slopes: Any, g: Any) -> Any:
    if g.shape[-1] == 1:
        return g / slopes[..., 0]
    try:
        return np.linalg.solve(slopes, g[..., None])[..., 0]
    except np.linalg.LinAlgError:
        singular = ~(np.abs(np.linalg.det(slopes)) > 0)[..., None]
        matrix = np.where(singular[..., None], np.eye(g.shape[-1]), slopes)
        return np.where(singular, np.nan, np.linalg.solve(matrix, g[..., None])[..., 0])


def _numpy_search(equations: Any, block: Any, math: Any, given: Any, known: Any) -> Any:
    """As from `_newton`; derivatives of equations with unknown functions by differences."""
    *rest, networks = given
    method, derived, _, variables = block
    quiet = tuple(getattr(network, "quiet", network) for network in networks)
    start, low, high = (np.array([v[i] for v in variables]) for i in range(1, 4))
    sizes, n = _sizes(low, high, start), len(variables)

    def left(z: Any) -> Any:
        return getattr(equations, method)(math, *rest, quiet, (*known, *np.moveaxis(z, -1, 0)))

    def linear(z: Any) -> Any:
        if derived:
            g, slopes = getattr(equations, derived)(math, *rest, quiet, (*known, *np.moveaxis(z, -1, 0)))
            return g, slopes.reshape(*slopes.shape[:-1], n, n)
        change = 6e-6 * np.maximum(np.abs(z), 1e-3 * sizes)[..., None] * np.eye(n)  # a row for each variable
        sides = [(left(z + change[..., i, :]), left(z - change[..., i, :])) for i in range(n)]
        columns = [(a - b) / (2 * change[..., i, i, None]) for i, (a, b) in enumerate(sides)]
        return left(z), np.stack(columns, -1)

    with np.errstate(all="ignore"):
        shape = left(np.broadcast_to(start, (*np.shape(given[1])[:-1], n))).shape
        found, slopes, point = _newton(
            np, linear, _numpy_divided, np.broadcast_to(start, shape) + 0.0, (low, high, sizes)
        )
        for _ in range(2):
            found = found - _numpy_divided(slopes, left(found))
    return found, slopes, point


def _casadi_root(equations: Any, block: Any, math: Any, given: Any, known: Any) -> Any:
    """A block's variables, a column, with derivatives up to the third order."""
    import casadi as ca

    *rest, networks = given
    residual, variables = getattr(equations, block[0]), block[3]
    parts = [ca.vertcat(*part) if isinstance(part, tuple) else part for part in (*rest, known)]
    values = [ca.MX(part) for part in parts]
    inner = [ca.MX.sym(f"p{i}", *part.shape) for i, part in enumerate(values)]
    z = ca.MX.sym("z", len(variables))
    left = residual(math, *inner[:4], math.unpack(inner[4]), networks, (*math.unpack(inner[5]), *math.unpack(z)))
    both = ca.Function("both", [z, *inner], [ca.densify(left), ca.densify(ca.jacobian(left, z))])
    both = both.expand() if block[1] else both  # without products of matrices several times as fast
    search = _casadi_search(both, inner, variables)
    found, slopes = search(*values)
    for _ in range(3):
        found = found - _casadi_divide(len(variables))(slopes, both(found, *values)[0])
    return found


def _casadi_divide(size: int) -> Any:
    """The solution of linear equations, without pivots, so that a singular matrix gives NaN and no error."""
    import casadi as ca

    matrix, right = ca.SX.sym("matrix", size, size), ca.SX.sym("right", size)
    return ca.Function("divide", [matrix, right], [ca.solve(matrix, right)])


def _casadi_search(both: Any, inner: Any, variables: Any) -> Any:
    """The function that gives a block's variables and the derivatives there, both without derivatives of their own;
    the same steps as in `_newton`, of which those after the last one cost nothing."""
    import casadi as ca

    begin, lowest, highest = (np.array([v[i] for v in variables]) for i in range(1, 4))
    start, low, high, sizes = map(ca.DM, (begin, lowest, highest, _sizes(lowest, highest, begin)))
    n, divide = len(variables), _casadi_divide(len(variables))
    state = ca.MX.sym(
        "state", 3 * n + 3
    )  # point, step, weights; largest weighted residual, share of the step, whether done
    z, step, weights, merit, size, _ = ca.vertsplit(state, [0, n, 2 * n, 3 * n, 3 * n + 1, 3 * n + 2, 3 * n + 3])

    def accepted(at: Any, g: Any, slopes: Any) -> Any:
        ahead = -divide(slopes, g)
        total = ca.fabs(slopes) @ sizes
        new = 1.0 / ca.if_else(total > 0, total, 1.0)
        room = ca.mmin(ca.if_else(ahead > 0, high - at, at - low) / (ca.fabs(ahead) + 1e-300))
        share = ca.if_else(room >= 1.0, 1.0, _INSIDE * room)
        done = ca.mmax(ca.fabs(ahead) / (ca.fabs(at) + sizes)) <= np.finfo(np.float64).eps ** 0.45
        done = ca.if_else(done, 1.0, ca.if_else(share * ca.mmax(ca.fabs(ahead) / sizes) >= _LEAST, 0.0, -1.0))
        return ca.vertcat(at, ahead, new, ca.mmax(ca.fabs(g) * new), share, done)

    trial = z + size * step
    g, slopes = both(trial, *inner)
    better = ca.mmax(ca.fabs(g) * weights) <= (1.0 - _ENOUGH * size) * merit
    least = ca.if_else(0.5 * size * ca.mmax(ca.fabs(step) / sizes) >= _LEAST, 0.0, -1.0)
    shorter = ca.vertcat(z, step, weights, merit, 0.5 * size, least)
    going = ca.Function("going", [state, *inner], [ca.if_else(better, accepted(trial, g, slopes), shorter)])
    going = going.expand() if both.is_a("SXFunction") else going
    resting = ca.Function("resting", [state, *inner], [state])
    tick = ca.Function.if_else("tick", going, resting)
    now = accepted(start, *both(start, *inner))
    for _ in range(_TICKS):
        now = tick(now[-1] == 0, now, *inner)
    point = ca.if_else(now[-1] == 1, now[:n], np.nan)
    constant = {"is_diff_in": [False] * len(inner), "is_diff_out": [False, False]}
    return ca.Function("search", inner, [point, both(point, *inner)[1]], constant)
