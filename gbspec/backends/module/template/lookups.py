"""Functions given by points, for any library. Only the modules of models with tables have this part."""

from __future__ import annotations

import functools
import math as _math
from typing import Any

import numpy as np

TABLES: dict[str, Any] = {}

# <body>
# -------------------------------------------------------------------------- tables
# A table is a polynomial in each piece between two places (`knots`) of its arguments, in the distances from the lower
# ones; `coefficients` are those of all pieces, lowest power first, the last argument changing fastest. Beyond the
# places the nearest value holds, or, where `strict`, there is none (NaN). `order`: a derivative, by argument.


@functools.cache
def _curve(name: str, order: tuple[int, ...]) -> Any:
    """The places of each argument, the coefficients of a derivative, and whether there are values within only."""
    table = TABLES[name]
    knots = [np.array(places) for places in table["knots"]]
    shape = (*(len(places) - 1 for places in knots), *(table["powers"],) * len(knots))
    found = np.array(table["coefficients"]).reshape(shape)
    for axis, times in enumerate(order, start=len(order)):
        for _ in range(times):
            powers = np.arange(1, found.shape[axis])
            found = np.moveaxis(np.moveaxis(found.take(powers, axis), axis, -1) * powers, -1, axis)
    return knots, found, table["strict"] and not any(order)


@functools.cache
def _torch_curve(name: str, order: tuple[int, ...], dtype: Any, device: Any) -> Any:
    import torch

    knots, found, strict = _curve(name, order)
    with torch.inference_mode(False), torch.no_grad():
        places = [torch.as_tensor(each, dtype=dtype, device=device) for each in knots]
        return places, torch.as_tensor(found, dtype=dtype, device=device), strict


def _lookup(name: str, *points: Any, order: tuple[int, ...] = ()) -> Any:
    """The value of a table, or of a derivative, at points of numpy, torch or casadi."""
    order = order or (0,) * len(points)
    libraries = {type(point).__module__.split(".")[0] for point in points}
    if "torch" in libraries:
        return _torch_lookup(name, points, order)
    return (_casadi_lookup if "casadi" in libraries else _numpy_lookup)(name, points, order)


def _polynomial(found: Any, steps: Any, unit: Any) -> Any:
    """The sum of coefficients [..., powers of each argument] times powers of the steps; the last argument first."""
    for step in reversed(steps):
        wide = unit(step, found.ndim - 1 - step.ndim)
        total = found[..., -1]
        for power in range(found.shape[-1] - 2, -1, -1):
            total = total * wide + found[..., power]
        found = total
    return found


def _numpy_lookup(name: str, points: Any, order: tuple[int, ...]) -> Any:
    knots, found, strict = _curve(name, order)
    given = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in points))
    inside = [np.clip(x, k[0], k[-1]) for x, k in zip(given, knots, strict=True)]
    places = [
        np.clip(np.searchsorted(k, x, side="right") - 1, 0, len(k) - 2) for x, k in zip(inside, knots, strict=True)
    ]
    steps = [x - k[place] for x, k, place in zip(inside, knots, places, strict=True)]
    value = _polynomial(found[tuple(places)], steps, lambda x, n: x.reshape(x.shape + (1,) * n))
    for x, k, times in zip(given, knots, order, strict=True):
        if strict or times:
            value = np.where((x < k[0]) | (x > k[-1]), np.nan if strict else 0.0, value)
    return value


def _torch_lookup(name: str, points: Any, order: tuple[int, ...]) -> Any:
    import torch

    like = next(x for x in points if isinstance(x, torch.Tensor))
    knots, found, strict = _torch_curve(name, order, like.dtype, like.device)
    tensors = [torch.as_tensor(x, dtype=like.dtype, device=like.device) for x in points]
    given = torch.broadcast_tensors(*tensors)  # type: ignore[no-untyped-call]
    inside = [x.clamp(k[0], k[-1]) for x, k in zip(given, knots, strict=True)]
    places = [
        (torch.bucketize(x.detach(), k, right=True) - 1).clamp(0, len(k) - 2)
        for x, k in zip(inside, knots, strict=True)
    ]
    steps = [x - k[place] for x, k, place in zip(inside, knots, places, strict=True)]
    value = _polynomial(found[tuple(places)], steps, lambda x, n: x.reshape(x.shape + (1,) * n))
    for x, k, times in zip(given, knots, order, strict=True):
        if strict or times:
            value = torch.where((x < k[0]) | (x > k[-1]), _math.nan if strict else 0.0, value)
    return value


def _casadi_lookup(name: str, points: Any, order: tuple[int, ...]) -> Any:
    import casadi as ca

    knots, found, strict = _curve(name, order)

    def chosen(x: Any, places: Any, first: int, last: int, entry: Any) -> Any:
        """The entry of the piece of x, by halving."""
        if last - first == 1:
            return entry(first)
        middle = (first + last) // 2
        low, high = chosen(x, places, first, middle, entry), chosen(x, places, middle, last, entry)
        return ca.if_else(ca.repmat(x < places[middle], 1, low.shape[1]), low, high)

    def along(axis: int, pieces: tuple[int, ...]) -> Any:
        """The polynomial, by the pieces of all arguments."""
        if axis == len(knots):
            return ca.DM(np.tile(found[pieces].reshape(1, -1), (count, 1)))
        x, places = inside[axis], knots[axis]
        return chosen(x, places, 0, len(places) - 1, lambda piece: along(axis + 1, (*pieces, piece)))

    count = max(x.shape[0] if hasattr(x, "shape") else 1 for x in points)  # of the elements of an array
    given = [x if hasattr(x, "shape") and x.shape[0] == count else ca.repmat(x, count, 1) for x in points]
    inside = [
        ca.if_else(x < places[0], places[0], ca.if_else(x > places[-1], places[-1], x))
        for x, places in zip(given, knots, strict=True)
    ]
    steps = []
    for x, places in zip(inside, knots, strict=True):
        steps.append(
            x
            - chosen(
                x, places, 0, len(places) - 1, lambda piece, places=places: ca.DM(np.full((count, 1), places[piece]))
            )
        )
    powers = found.shape[len(knots) :]
    if not all(powers):
        return 0 * given[0]
    rows = ca.horzsplit(along(0, ()))
    for step, size in zip(reversed(steps), reversed(powers), strict=True):
        groups = [rows[i : i + size] for i in range(0, len(rows), size)]
        rows = []
        for group in groups:
            total = group[-1]
            for c in reversed(group[:-1]):
                total = total * step + c
            rows.append(total)
    value = rows[0]
    for x, places, times in zip(given, knots, order, strict=True):
        if strict or times:
            beyond = ca.logic_or(x < places[0], x > places[-1])
            value = ca.if_else(beyond, _math.nan if strict else 0.0, value)
    return value
