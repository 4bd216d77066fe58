"""The arithmetics for a model's equations. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np

# <body>
# ---------------------------------------------------------------------- arithmetic
# One namespace per library, with the same names, so that the equations are written once. `where(condition, a, b)`
# chooses; `guard(condition, x)` is x, in torch with zero gradient where the condition does not hold; `ahead(x, h, k)`
# is x + h*k; `unpack` splits the last axis (tuples are returned as they are), `pack(like, parts)` stacks parts along
# a new one in the shape and type of `like`, `column` appends an axis, `columns` to each of several; `fill(like, x)` is
# a number for each point of a batch. On vectors along the last axis, `part` takes components, `entry` one, `total`
# their sum; `join` concatenates vectors, `repeat` repeats a scalar, `indices` is a range of integers.
# `factored(rhs, t, x, u, size)` returns a function that divides vectors by I - size times the Jacobian of rhs(t, x, u)
# at x, which is a constant in torch's derivatives.


@functools.cache
def _torch_arithmetic() -> Any:
    import torch
    from torch import Tensor
    from torch.nn.functional import softplus

    def tensor(value: Any) -> Any:
        return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)

    def unary(function: Any) -> Any:
        return lambda a: function(a if isinstance(a, Tensor) else tensor(a))

    def alike(a: Any, b: Any) -> tuple[Any, Any]:
        """Both as tensors; a number beside a tensor has its type, which it would widen where that is a scalar."""
        if isinstance(a, Tensor):
            return a, b if isinstance(b, Tensor) else a.new_tensor(b)
        return (b.new_tensor(a), b) if isinstance(b, Tensor) else (tensor(a), tensor(b))

    def binary(function: Any) -> Any:
        return lambda a, b: function(*alike(a, b))

    def where(condition: Any, a: Any, b: Any) -> Any:
        condition = condition if isinstance(condition, Tensor) else torch.as_tensor(condition)
        return torch.where(condition, *alike(a, b))

    def guard(condition: Any, x: Any) -> Any:
        x = tensor(x)
        return where(condition, x, x.detach()) if x.requires_grad else x

    def pack(like: Any, parts: Any) -> Any:
        shape = like.shape[:-1]
        if not parts:
            return like.new_zeros((*shape, 0))
        if all(isinstance(part, Tensor) and part.shape == shape for part in parts):
            return torch.stack(parts, -1).to(like.dtype)
        whole = [part if isinstance(part, Tensor) else like.new_tensor(part) for part in parts]
        shape = np.broadcast_shapes(shape, *(part.shape for part in whole))
        return torch.stack([part.expand(shape) for part in whole], -1).to(like.dtype)

    def column(x: Any) -> Any:
        return x.unsqueeze(-1) if isinstance(x, Tensor) and x.ndim else x

    def join(like: Any, *parts: Any) -> Any:
        whole = [part if isinstance(part, Tensor) else like.new_tensor(part) for part in parts]
        whole = [part if part.ndim else part[None] for part in whole]
        shape = np.broadcast_shapes(like.shape[:-1], *(part.shape[:-1] for part in whole))
        # what was chosen among numbers, in their full precision, is wider than float32
        return torch.cat([part.expand(*shape, part.shape[-1]) for part in whole], -1).to(like.dtype)

    def repeat(like: Any, x: Any, count: int) -> Any:
        x = column(x) if isinstance(x, Tensor) else like.new_tensor(x)
        return x.expand(*np.broadcast_shapes(like.shape[:-1], x.shape[:-1]), count)

    names = "exp log sin cos tan tanh sinh cosh asin acos atan asinh acosh atanh sqrt abs sign floor"
    return SimpleNamespace(
        **{name: unary(getattr(torch, name)) for name in names.split()},
        softplus=unary(lambda a: softplus(a, threshold=40.0)),  # torch's default of 20 loses five digits
        logistic=unary(torch.sigmoid),
        atan2=binary(torch.atan2),
        minimum=binary(torch.minimum),
        maximum=binary(torch.maximum),
        logical_and=lambda a, b: torch.logical_and(torch.as_tensor(a), torch.as_tensor(b)),
        logical_or=lambda a, b: torch.logical_or(torch.as_tensor(a), torch.as_tensor(b)),
        logical_not=lambda a: torch.logical_not(torch.as_tensor(a)),
        where=where,
        guard=guard,
        unpack=lambda x: x if isinstance(x, tuple) else x.unbind(-1),
        pack=pack,
        column=column,
        columns=lambda values: tuple(map(column, values)),
        fill=lambda like, x: like.new_tensor(x).expand(like.shape[:-1]),
        ahead=lambda x, h, k: torch.addcmul(x, h, k) if isinstance(h, Tensor) else torch.add(x, k, alpha=h),
        part=lambda x, *ends: x[..., slice(*ends) if len(ends) < 3 else list(range(*ends))],
        entry=lambda x, place: x[..., place],
        total=lambda x: x.sum(-1),
        join=join,
        repeat=repeat,
        factored=_torch_factored,
        indices=lambda like, *ends: torch.arange(*ends, dtype=like.dtype, device=like.device).expand(
            *like.shape[:-1], ends[1] - ends[0]
        ),
        pi=np.pi,
        inf=np.inf,
        nan=np.nan,
    )


def _torch_factored(rhs: Any, t: Any, x: Any, u: Any, size: Any) -> Any:
    import torch

    with torch.enable_grad():
        at = x.detach().requires_grad_()
        rates = rhs(t, at, u) + 0.0 * at  # which depends on the state even where the rates do not
        rows = [torch.autograd.grad(rate.sum(), at, retain_graph=True)[0] for rate in rates.unbind(-1)]
    step = size.detach().unsqueeze(-1) if isinstance(size, torch.Tensor) and size.ndim else size
    unit = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    factors = torch.linalg.lu_factor(unit - step * torch.stack(rows, -2))
    return lambda b: torch.linalg.lu_solve(*factors, b.unsqueeze(-1)).squeeze(-1)


@functools.cache
def _casadi_arithmetic() -> Any:
    import casadi as ca

    def factored(rhs: Any, t: Any, x: Any, u: Any, size: Any) -> Any:
        at = type(x).sym("at", x.shape[0])
        slopes = ca.substitute(ca.jacobian(rhs(t, at, u), at), at, x)
        matrix = ca.densify(ca.DM.eye(x.shape[0]) - size * slopes)
        return lambda b: ca.solve(matrix, b, "qr") if isinstance(matrix, ca.MX) else ca.solve(matrix, b)

    names = "exp log sin cos tan tanh sinh cosh asin acos atan asinh acosh atanh sqrt sign floor atan2"
    return SimpleNamespace(
        **{name: getattr(ca, name) for name in names.split()},
        softplus=lambda a: ca.if_else(a > 40.0, a, ca.log1p(ca.exp(ca.fmin(a, 40.0)))),
        logistic=lambda a: 1.0 / (1.0 + ca.exp(ca.fmin(-a, 300.0))),
        abs=ca.fabs,
        minimum=ca.fmin,
        maximum=ca.fmax,
        logical_and=ca.logic_and,
        logical_or=ca.logic_or,
        logical_not=ca.logic_not,
        where=ca.if_else,
        guard=lambda condition, x: x,
        unpack=lambda x: tuple(ca.vertsplit(x)) if x.shape[0] else (),
        pack=lambda like, parts: ca.vertcat(*parts) if parts else type(like)(0, 1),
        column=lambda h: h,
        columns=lambda values: values,
        fill=lambda like, x: x,
        ahead=lambda x, h, k: x + h * k,
        part=lambda x, *ends: x[slice(*ends) if len(ends) < 3 else list(range(*ends))],
        entry=lambda x, place: x[place],
        total=ca.sum1,
        join=lambda like, *parts: ca.vertcat(*parts),
        repeat=lambda like, x, count: ca.repmat(type(like)(x), count, 1),
        factored=factored,
        indices=lambda like, *ends: type(like)(ca.DM(range(*ends))),
        pi=np.pi,
        inf=np.inf,
        nan=np.nan,
    )


@functools.cache
def _numpy_arithmetic() -> Any:
    def join(like: Any, *parts: Any) -> Any:
        whole = [np.atleast_1d(part) for part in parts]
        shape = np.broadcast_shapes(np.shape(like)[:-1], *(part.shape[:-1] for part in whole))
        return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in whole], -1)

    def repeat(like: Any, x: Any, count: int) -> Any:
        return np.broadcast_to(np.expand_dims(x, -1), (*np.broadcast_shapes(np.shape(like)[:-1], np.shape(x)), count))

    def factored(rhs: Any, t: Any, x: Any, u: Any, size: Any) -> Any:
        change = 6e-6 * np.maximum(np.abs(x), 1e-6)[..., None] * np.eye(x.shape[-1])  # a row for each state
        ends = [[rhs(t, x + s * change[..., i, :], u) for s in (1, -1)] for i in range(x.shape[-1])]
        columns = [(a - b) / (2 * change[..., i, i, None]) for i, (a, b) in enumerate(ends)]
        matrix = np.eye(x.shape[-1]) - (size[..., None] if np.ndim(size) else size) * np.stack(columns, -1)
        return lambda b: np.linalg.solve(matrix, b[..., None])[..., 0]

    names = "exp log sin cos tan tanh sinh cosh sqrt abs sign floor minimum maximum where"
    names += " logical_and logical_or logical_not"
    return SimpleNamespace(
        **{name: getattr(np, name) for name in names.split()},
        **{f"a{name}": getattr(np, f"arc{name}") for name in ["sin", "cos", "tan", "sinh", "cosh", "tanh", "tan2"]},
        softplus=lambda a: np.logaddexp(a, 0.0),
        logistic=lambda a: 1.0 / (1.0 + np.exp(np.minimum(-a, 300.0))),
        guard=lambda condition, x: x,
        unpack=lambda x: tuple(np.moveaxis(x, -1, 0)),
        pack=lambda like, parts: (
            np.stack(np.broadcast_arrays(np.zeros(np.shape(like)[:-1]), *parts)[1:], -1)
            if parts
            else np.zeros((*np.shape(like)[:-1], 0))
        ),
        column=lambda h: np.expand_dims(h, -1),
        columns=lambda values: tuple(np.expand_dims(value, -1) for value in values),
        fill=lambda like, x: np.broadcast_to(x, np.shape(like)[:-1]),
        ahead=lambda x, h, k: x + h * k,
        part=lambda x, *ends: x[..., slice(*ends) if len(ends) < 3 else list(range(*ends))],
        entry=lambda x, place: x[..., place],
        total=lambda x: np.sum(x, -1),
        join=join,
        repeat=repeat,
        factored=factored,
        indices=lambda like, *ends: np.broadcast_to(
            np.arange(*ends, dtype=np.float64), (*np.shape(like)[:-1], ends[1] - ends[0])
        ),
        pi=np.pi,
        inf=np.inf,
        nan=np.nan,
    )


def _arithmetic(library: str) -> Any:
    table = {"torch": _torch_arithmetic, "casadi": _casadi_arithmetic, "numpy": _numpy_arithmetic}
    if library not in table:
        raise ValueError(f"unknown arithmetic {library!r}; available: {', '.join(table)}")
    return table[library]()
