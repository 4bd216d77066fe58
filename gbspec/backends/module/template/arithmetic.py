"""The arithmetics in which a model's equations run. Everything above the line `# <body>` stays behind."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np

# <body>
# ---------------------------------------------------------------------- arithmetic
# One namespace a library, all with the same names, so that the equations are written once. `where(condition, a, b)`
# chooses; `guard(condition, x)` is x, in torch with its gradient cut off where the condition does not hold; `unpack`
# splits the last axis, `pack(like, parts)` joins parts along a new one in the shape and type of `like`, `column`
# appends an axis.


@functools.cache
def _torch_arithmetic() -> Any:
    import torch
    from torch import Tensor
    from torch.nn.functional import softplus

    def tensor(value: Any) -> Any:
        return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)

    def unary(function: Any) -> Any:
        return lambda a: function(a if isinstance(a, Tensor) else tensor(a))

    def binary(function: Any) -> Any:
        return lambda a, b: function(tensor(a), tensor(b))

    def where(condition: Any, a: Any, b: Any) -> Any:
        condition = condition if isinstance(condition, Tensor) else torch.as_tensor(condition)
        return torch.where(condition, tensor(a), tensor(b))

    def guard(condition: Any, x: Any) -> Any:
        x = tensor(x)
        return where(condition, x, x.detach()) if x.requires_grad else x

    def pack(like: Any, parts: Any) -> Any:
        shape = like.shape[:-1]
        if not parts:
            return like.new_zeros((*shape, 0))
        if all(isinstance(part, Tensor) and part.shape == shape for part in parts):
            return torch.stack(parts, -1)
        whole = [part if isinstance(part, Tensor) else like.new_tensor(part) for part in parts]
        shape = np.broadcast_shapes(shape, *(part.shape for part in whole))
        return torch.stack([part.expand(shape) for part in whole], -1)

    names = "exp log sin cos tan tanh sinh cosh asin acos atan asinh acosh atanh sqrt abs sign"
    return SimpleNamespace(
        **{name: unary(getattr(torch, name)) for name in names.split()},
        softplus=unary(lambda a: softplus(a, threshold=40.0)),  # torch's own threshold, 20, costs five digits
        logistic=unary(torch.sigmoid),
        atan2=binary(torch.atan2),
        minimum=binary(torch.minimum),
        maximum=binary(torch.maximum),
        logical_and=lambda a, b: torch.logical_and(torch.as_tensor(a), torch.as_tensor(b)),
        logical_or=lambda a, b: torch.logical_or(torch.as_tensor(a), torch.as_tensor(b)),
        logical_not=lambda a: torch.logical_not(torch.as_tensor(a)),
        where=where,
        guard=guard,
        unpack=lambda x: x.unbind(-1),
        pack=pack,
        column=lambda h: h.unsqueeze(-1) if isinstance(h, Tensor) and h.ndim else h,
        pi=np.pi,
        inf=np.inf,
        nan=np.nan,
    )


@functools.cache
def _casadi_arithmetic() -> Any:
    import casadi as ca

    names = "exp log sin cos tan tanh sinh cosh asin acos atan asinh acosh atanh sqrt sign atan2"
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
        pi=np.pi,
        inf=np.inf,
        nan=np.nan,
    )


@functools.cache
def _numpy_arithmetic() -> Any:
    names = "exp log sin cos tan tanh sinh cosh sqrt abs sign minimum maximum logical_and logical_or logical_not where"
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
        pi=np.pi,
        inf=np.inf,
        nan=np.nan,
    )


def _arithmetic(library: str) -> Any:
    table = {"torch": _torch_arithmetic, "casadi": _casadi_arithmetic, "numpy": _numpy_arithmetic}
    if library not in table:
        raise ValueError(f"no arithmetic is called {library!r}; there are {', '.join(table)}")
    return table[library]()
