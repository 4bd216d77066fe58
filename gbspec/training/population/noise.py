"""The variance of measurements as a function of predictions and learned constants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce
from operator import mul

import sympy
import torch
from torch import Tensor

from gbspec.diagnostics import Defect
from gbspec.ir import PREDICTION, Expr, Model, Noise

LEAST = 1e-150
"""Variances are at least this."""

_UNARY: Mapping[type[sympy.Basic], Callable[[Tensor], Tensor]] = {
    sympy.exp: torch.exp,
    sympy.log: torch.log,
    sympy.sin: torch.sin,
    sympy.cos: torch.cos,
    sympy.tan: torch.tan,
    sympy.tanh: torch.tanh,
    sympy.sinh: torch.sinh,
    sympy.cosh: torch.cosh,
    sympy.asin: torch.asin,
    sympy.acos: torch.acos,
    sympy.atan: torch.atan,
    sympy.asinh: torch.asinh,
    sympy.acosh: torch.acosh,
    sympy.atanh: torch.atanh,
    sympy.Abs: torch.abs,
    sympy.sign: torch.sign,
    sympy.floor: torch.floor,
}


def evaluated(expression: Expr, values: Mapping[sympy.Symbol, Tensor], like: Tensor) -> Tensor:
    """The value of an expression, differentiable in the values of its symbols."""
    if expression.is_Symbol:
        return values[expression]
    if expression.is_number:
        return like.new_tensor(float(expression)).expand_as(like)
    parts = [evaluated(argument, values, like) for argument in expression.args if not argument.is_Boolean]
    if isinstance(expression, sympy.Add):
        return torch.stack(torch.broadcast_tensors(*parts)).sum(0)  # type: ignore[no-untyped-call]  # torch does not annotate it
    if isinstance(expression, sympy.Mul):
        return reduce(mul, parts)  # derivatives of `Tensor.prod` divide by the factors, which may be next to 0
    if isinstance(expression, sympy.Pow):
        exponent = expression.args[1]
        return parts[0] ** float(exponent) if exponent.is_number else parts[0] ** parts[1]
    if isinstance(expression, sympy.Max | sympy.Min):
        stacked = torch.stack(torch.broadcast_tensors(*parts))  # type: ignore[no-untyped-call]  # torch does not annotate it
        return stacked.amax(0) if isinstance(expression, sympy.Max) else stacked.amin(0)
    function = _UNARY.get(type(expression))
    if function is None or len(parts) != 1:
        raise Defect(f"the noise contains `{type(expression).__name__}`, which has no rule here")
    return function(parts[0])


def rule_for(noise: Noise) -> bool:
    """Whether the expression of a noise can be evaluated here: it contains no conditional."""
    return noise.value is None or not noise.value.atoms(sympy.Piecewise)


def shape_parameter(model: Model, channel: int, constants: Mapping[sympy.Symbol, Tensor], like: Tensor) -> Tensor:
    """The shape [m] of the noise of a channel, as the degrees of freedom of Student's; 1 where it has none."""
    noise = model.channels[channel].noise
    if noise is None or noise.shape is None:
        return torch.ones_like(like)
    known = {c.symbol: like.new_tensor(c.value) for c in model.constants}
    return evaluated(noise.shape, {**known, **constants}, like).expand_as(like)


def single_variance(model: Model, channel: int, prediction: Tensor, constants: Mapping[sympy.Symbol, Tensor]) -> Tensor:
    """The variance of a single measurement of a channel [m], of its logarithm under lognormal noise; the square of the
    scale of Student's.

    `prediction` [m] is in the channel's unit; `constants` has the values [m] of learnables and of what is implied.
    """
    noise = model.channels[channel].noise
    if noise is None:
        raise Defect("a channel without noise has no likelihood")
    if noise.value is None:
        square = torch.full_like(prediction, noise.scale**2)
    else:
        known = {c.symbol: prediction.new_tensor(c.value) for c in model.constants}
        # The square of the expression, not that of its value: where it is a root, as of counts, the root has no
        # derivative at 0, and its square has one.
        found = evaluated(noise.value**2, {**known, **constants, PREDICTION: prediction}, prediction)
        square = torch.where(found < 0, torch.nan, found).expand_as(prediction)  # of the root of a negative number
    return torch.log1p(square) if noise.kind == "lognormal" else square
