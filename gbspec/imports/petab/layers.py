"""Layers of networks that act on arrays, as formulas: windows of pictures, flattening, and linear maps.

Arrays have the shapes of PyTorch: a picture is [channels, height, width], or one more axis of length 1 before it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gbspec.imports.formulas import ZERO, Formula, call, number

Formulas: TypeAlias = NDArray[Any]
"""An array of formulas."""
MOST_TERMS = 20_000
"""The most products of a layer that are written as formulas."""
Window: TypeAlias = tuple[tuple[int, int, int], list[tuple[tuple[int, int, int], Formula]]]
"""A place of the result, and the places in the window with what is there."""


class NotOfferedLayerError(Exception):
    """A layer that has no form, and why."""


def array(values: list[Formula]) -> Formulas:
    """A vector."""
    made = np.empty(len(values), dtype=object)
    made[:] = values
    return made


def linear(x: Formulas, weight: Formulas, bias: Formulas | None, named: Callable[[str, Formula], Formula]) -> Formulas:
    """W x + b along the last axis; `named` gives each sum a name, from its place."""
    rows = x.reshape(-1, x.shape[-1])
    if weight.ndim != 2 or weight.shape[1] != rows.shape[1]:
        raise NotOfferedLayerError(f"its weights do not fit its {rows.shape[1]} arguments")
    _counted(len(rows) * weight.size)
    out = np.empty((len(rows), len(weight)), dtype=object)
    for r, i in np.ndindex(*out.shape):
        total = _sum(weight[i] * rows[r], ZERO if bias is None else bias[i])
        out[r, i] = named(str(i) if len(rows) == 1 else f"{r}_{i}", total)
    return out.reshape(*x.shape[:-1], len(weight))


def convolved(
    x: Formulas, weight: Formulas, bias: Formulas | None, args: Mapping[str, Any],
    named: Callable[[str, Formula], Formula],
) -> Formulas:  # fmt: skip
    """Conv2d without groups, with zeros around the picture."""
    if args.get("groups", 1) != 1 or args.get("padding_mode", "zeros") != "zeros":
        raise NotOfferedLayerError("groups, and other paddings than zeros, are not offered")
    picture = _picture(x)
    if weight.ndim != 4 or weight.shape[1] != len(picture):
        raise NotOfferedLayerError(f"its weights do not fit {len(picture)} channels")
    size = weight.shape[2:]
    shape, windows = _windows(picture, size, args)
    _counted(int(np.prod(shape)) * weight.size)
    out = np.empty((len(weight), *shape), dtype=object)
    for (c, i, j), window in _grouped(windows, len(picture)):
        if c:
            continue
        for o in range(len(weight)):
            terms = [weight[(o, *place)] * value for place, value in window]
            out[o, i, j] = named(f"{o}_{i}_{j}", _sum(terms, ZERO if bias is None else bias[o]))
    return _like(out, x)


def pooled(x: Formulas, kind: str, args: Mapping[str, Any]) -> Formulas:
    """MaxPool2d and AvgPool2d, without a padding."""
    if _pair(args.get("padding", 0)) != (0, 0) or args.get("ceil_mode"):
        raise NotOfferedLayerError("a padding, and rounding up, are not offered")
    picture, size = _picture(x), _pair(args.get("kernel_size", 1))
    given = {**args, "stride": args.get("stride") or size}
    shape, windows = _windows(picture, size, given)
    out = np.empty((len(picture), *shape), dtype=object)
    for place, window in windows:
        values = [value for _, value in window]
        if kind == "MaxPool2d":
            out[place] = values[0] if len(values) == 1 else call("max", *values)
        else:
            out[place] = Formula("/", (_sum(values, ZERO), number(len(values))))
    return _like(out, x)


def flattened(x: Formulas, args: Mapping[str, Any]) -> Formulas:
    """Flatten; a vector stays one."""
    begin, end = int(args.get("start_dim", 1)), int(args.get("end_dim", -1)) % max(x.ndim, 1)
    if begin > end:
        return x
    return x.reshape(*x.shape[:begin], -1, *x.shape[end + 1 :])


# ----------------------------------------------------------------------------------------------------------- windows
def _windows(
    picture: Formulas, size: tuple[int, ...], args: Mapping[str, Any]
) -> tuple[tuple[int, int], Iterator[Window]]:
    """The height and width of the result, and each channel's windows; zeros around the picture are left out."""
    stride, padding = _pair(args.get("stride", 1)), _pair(args.get("padding", 0))
    dilation = _pair(args.get("dilation", 1))
    high, wide = (
        (picture.shape[k + 1] + 2 * padding[k] - dilation[k] * (size[k] - 1) - 1) // stride[k] + 1 for k in range(2)
    )
    if high < 1 or wide < 1:
        raise NotOfferedLayerError("its window is larger than the picture")

    def every() -> Iterator[Window]:
        for i, j in itertools.product(range(high), range(wide)):
            for c in range(len(picture)):
                found = []
                for p, q in itertools.product(range(size[0]), range(size[1])):
                    row, column = (
                        i * stride[0] + p * dilation[0] - padding[0],
                        j * stride[1] + q * dilation[1] - padding[1],
                    )
                    if 0 <= row < picture.shape[1] and 0 <= column < picture.shape[2]:
                        found.append(((c, p, q), picture[c, row, column]))
                yield (c, i, j), found

    return (high, wide), every()


def _grouped(windows: Iterator[Window], channels: int) -> Iterator[Window]:
    """The windows of all channels at one place together, as one of the first channel."""
    while group := list(itertools.islice(windows, channels)):
        yield group[0][0], [part for _, window in group for part in window]


def _picture(x: Formulas) -> Formulas:
    found = x[0] if x.ndim == 4 and len(x) == 1 else x
    if found.ndim != 3:
        raise NotOfferedLayerError(f"its argument has {x.ndim} axes, and is no picture [channels, height, width]")
    return found


def _like(out: Formulas, x: Formulas) -> Formulas:
    return out[None] if x.ndim == 4 else out


def _pair(value: Any) -> tuple[int, int]:
    if isinstance(value, list | tuple):
        if len(value) != 2:
            raise NotOfferedLayerError(f"`{value}` has not two entries")
        return int(value[0]), int(value[1])
    return int(value), int(value)


def _sum(terms: Any, first: Any) -> Any:
    for term in terms:
        first = first + term
    return first


def _counted(terms: int) -> None:
    if terms > MOST_TERMS:
        raise NotOfferedLayerError(f"it has {terms:,} products; {MOST_TERMS:,} are offered")
