"""The compiled `recursion.c`, which needs a C compiler on this machine; without one the recursion is numpy's."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from importlib import resources

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import CompilerError, compiled
from gbspec.training.engines.filter import recursion
from gbspec.training.engines.filter.recursion import Flow, Innovations, Kept, Moment, Reading
from gbspec.training.problem import Integers

Advance = Callable[[Moment, Integers, Flow, Reading, Integers, Kept | None], Innovations]

SIZES = ("legs", "n", "channels", "width")
POINTERS = (
    *("owner", "place", "m", "p", "dm", "dp"),
    *("at", "mean", "a", "q", "by_moment", "by_rest", "d_mean", "d_a", "d_q"),
    *("read_at", "y", "c", "value", "r", "read_by_moment", "read_by_rest", "d_y", "d_c", "d_r", "seen"),
    *("before_m", "before_p", "end_m", "end_p", "post_m", "post_p"),
    *("error", "variance", "predicted", "d_error", "d_variance", "work"),
)
"""The fields of the struct, in its order."""


class _Sweep(ctypes.Structure):
    _fields_ = tuple([(name, ctypes.c_int64) for name in SIZES] + [(name, ctypes.c_void_p) for name in POINTERS])


@cache
def advance() -> Advance:
    """`recursion.advanced`, compiled where there is a compiler."""
    text = resources.files("gbspec.training.engines.filter").joinpath("recursion.c").read_text(encoding="utf-8")
    try:
        function = compiled(text).advance
    except CompilerError:
        return recursion.advanced
    function.restype, function.argtypes = None, [ctypes.POINTER(_Sweep)]

    def advanced(
        moment: Moment, owner: Integers, flow: Flow, reading: Reading, place: Integers, kept: Kept | None
    ) -> Innovations:
        n, (rows, channels) = flow.at.shape[1], reading.y.shape
        width = 0 if moment.dm is None else moment.dm.shape[2]
        out = Innovations.empty(rows, channels, None if moment.dm is None else width)
        moments = (moment, *((kept.before, kept.end, kept.post) if kept is not None else ()))
        written = [table for each in (*moments, out) for table in vars(each).values()]
        tables: dict[str, np.ndarray | None] = {"owner": owner, "place": place}
        tables |= dict(zip(("m", "p", "dm", "dp"), vars(moment).values(), strict=True))
        tables |= (
            vars(reading) | {f"read_{k}": getattr(reading, k) for k in ("at", "by_moment", "by_rest")} | vars(flow)
        )
        if kept is not None:
            for name in ("before", "end", "post"):
                tables |= {f"{name}_m": getattr(kept, name).m, f"{name}_p": getattr(kept, name).p}
        tables |= {"error": out.error, "variance": out.variance, "predicted": out.mean}
        tables |= {"d_error": out.d_error, "d_variance": out.d_variance, "work": _work(n, width, channels)}
        # What is read may be views in another order; what is written has been made here or by the caller.
        held = {k: v if v is None or _is(v, written) else np.ascontiguousarray(v) for k, v in tables.items()}
        addresses = {k: None if v is None else v.ctypes.data for k, v in held.items()}
        function(ctypes.byref(_Sweep(len(owner), n, channels, width, *(addresses.get(k) for k in POINTERS))))
        return out

    return advanced


def _work(n: int, width: int, channels: int) -> Array:
    return np.empty((10 * (n * n + n) + channels * (n + 2)) * (width + 1))


def _is(table: np.ndarray, others: list[np.ndarray | None]) -> bool:
    return any(table is other for other in others)
