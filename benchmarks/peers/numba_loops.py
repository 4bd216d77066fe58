"""The whole unroll, forward and in reverse, in Python loops compiled by numba: the kernel's algorithm without C.

Optimised: tiles of four trajectories that store their activations, products in blocks of four rows by four terms, the
logistic function as a polynomial over a layer (`math.exp` would be one call per number).
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import njit

from benchmarks.workload import Workload

TILE = 4
AHEAD, WEIGHT = (0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)
"""For each Runge-Kutta stage the step along the previous slope, and the weight."""


@njit(fastmath=True)
def add_product(c, a, b):
    """c [4, n] += a [4, m] b [m, n]; m is a multiple of 4."""
    for k in range(0, a.shape[1], 4):
        a00, a01, a02, a03 = a[0, k], a[0, k + 1], a[0, k + 2], a[0, k + 3]
        a10, a11, a12, a13 = a[1, k], a[1, k + 1], a[1, k + 2], a[1, k + 3]
        a20, a21, a22, a23 = a[2, k], a[2, k + 1], a[2, k + 2], a[2, k + 3]
        a30, a31, a32, a33 = a[3, k], a[3, k + 1], a[3, k + 2], a[3, k + 3]
        for j in range(c.shape[1]):
            b0, b1, b2, b3 = b[k, j], b[k + 1, j], b[k + 2, j], b[k + 3, j]
            c[0, j] += a00 * b0 + a01 * b1 + a02 * b2 + a03 * b3
            c[1, j] += a10 * b0 + a11 * b1 + a12 * b2 + a13 * b3
            c[2, j] += a20 * b0 + a21 * b1 + a22 * b2 + a23 * b3
            c[3, j] += a30 * b0 + a31 * b1 + a32 * b2 + a33 * b3


@cache
def _forward(name: str) -> Any:
    """The network's hidden layers and output for one type of numbers, whose constants the activation holds."""
    real, terms, most, shift = (np.float32, 8, 60.0, 23) if name == "float32" else (np.float64, 14, 300.0, 52)
    whole, bias = (np.int32, np.int32(127)) if name == "float32" else (np.int64, np.int64(1023))
    power = tuple(real(c) for c in _power_of_2(terms))
    per_ln2, half, one, most = real(-1 / np.log(2.0)), real(0.5), real(1), real(most)

    @njit(fastmath=True)
    def silu(z, slope, e, bits):
        """Replaces z [TILE, width] by z p(z) and computes its slope; `bits` is an integer view of `e`."""
        for t in range(TILE):
            for i in range(z.shape[1]):
                y = min(max(z[t, i], -most), most) * per_ln2
                n = np.floor(y + half)
                bits[i] = (whole(n) + bias) << shift
                r = y - n
                p = power[0]
                for c in power[1:]:
                    p = p * r + c
                slope[t, i] = p
            for i in range(z.shape[1]):
                rest = slope[t, i] * e[i]
                p = one / (one + rest)
                z[t, i] *= p
                slope[t, i] = z[t, i] * (rest * p) + p

    @njit(fastmath=True)
    def forward(x, bias1, layers, a1, d1, a2, d2, e, bits, y):
        """Outputs `y` [TILE] at states x [n, TILE]; stores activations a and slopes d."""
        first, _, _, w2t, b2, w3, b3 = layers
        for t in range(TILE):
            for i in range(a1.shape[1]):
                a1[t, i] = bias1[t, i] + first[0, i] * x[0, t] + first[1, i] * x[1, t]
                a2[t, i] = b2[i]
        silu(a1, d1, e, bits)
        add_product(a2, a1, w2t)
        silu(a2, d2, e, bits)
        for t in range(TILE):
            y[t] = b3[0]
            for i in range(a1.shape[1]):
                y[t] += w3[i] * a2[t, i]

    return forward


@njit(fastmath=True)
def reverse(yb, layers, d1, d2, da, xb):
    """From the outputs' cotangents to those of both layers, which replace the slopes, and of the states."""
    first, _, w2, _, _, w3, _ = layers
    for t in range(TILE):
        for i in range(d1.shape[1]):
            d2[t, i] *= yb[t] * w3[i]
            da[t, i] = 0
    add_product(da, d2, w2)
    for t in range(TILE):
        to_x1 = to_x2 = da.dtype.type(0)
        for i in range(d1.shape[1]):
            d1[t, i] *= da[t, i]
            to_x1 += d1[t, i] * first[0, i]
            to_x2 += d1[t, i] * first[1, i]
        xb[0, t] += to_x1
        xb[1, t] += to_x2


@njit(fastmath=True)
def add_gradients(x, yb, a1, d1, a2, d2, own, gradients):
    """Contributions of a step's four Runge-Kutta stages to the gradients of weights, and (`own` [TILE, width]) of each
    trajectory's first bias."""
    d_first, _, d_w2, d_b2, d_w3, d_b3 = gradients
    width = a1.shape[1]
    for q in range(4):
        for t in range(TILE):
            row, x1, x2, c = q * TILE + t, x[q, 0, t], x[q, 1, t], yb[q, t]
            d_b3[0] += c
            for i in range(width):
                own[t, i] += d1[row, i]
                d_first[0, i] += d1[row, i] * x1
                d_first[1, i] += d1[row, i] * x2
                d_b2[i] += d2[row, i]
                d_w3[i] += c * a2[row, i]
    for o in range(0, width, 4):
        add_product(d_w2[o : o + 4], d2[:, o : o + 4].T, a1)


@njit(fastmath=True)
def rates(x, k, y, out):
    """B, beta, the output's center and scale are `k`; `y` becomes the unknown's value."""
    for t in range(TILE):
        y[t] = k[2] + k[3] * y[t]
        out[0, t] = y[t] - x[0, t]
        out[1, t] = k[0] * y[t] - (1 + k[1]) * x[1, t]
        for i in range(2, x.shape[0]):
            out[i, t] = x[i - 1, t] - x[i, t]


@njit(fastmath=True)
def rates_reverse(x, k, y, ob, xb, yb, d_k):
    for t in range(TILE):
        xb[0, t] = -ob[0, t]
        xb[1, t] = -(1 + k[1]) * ob[1, t]
        for i in range(2, x.shape[0]):
            xb[i - 1, t] += ob[i, t]
            xb[i, t] = -ob[i, t]
        d_k[0] += ob[1, t] * y[t]
        d_k[1] -= ob[1, t] * x[1, t]
        yb[t] = k[3] * (ob[0, t] + k[0] * ob[1, t])


@njit(fastmath=True)
def solve(forward, steps, own, h, rows, blend, layers, bias1, k, x, kept, e, bits):
    """The loss of a tile's solution from x [n, TILE]; `kept` stores what the reverse pass needs."""
    x_at, y_at, arrivals, a1, d1, a2, d2 = kept
    value, mask, factor = rows
    slope, total = np.zeros((4, *x.shape), x.dtype), 0.0
    for s in range(steps + 1):
        arrivals[s] = x
        for i in range(x.shape[0]):
            for t in range(TILE):
                off = x[i, t] - value[s, own + t, i]
                total += factor[s, own + t, i] * off * off
                x[i, t] -= blend * mask[s, own + t, i] * off
        for q in range(4 if s < steps else 0):
            for i in range(x.shape[0]):
                for t in range(TILE):
                    x_at[s, q, i, t] = x[i, t] + h[s, own + t] * AHEAD[q] * slope[q - 1, i, t]
            at = slice(q * TILE, (q + 1) * TILE)
            forward(x_at[s, q], bias1, layers, a1[s, at], d1[s, at], a2[s, at], d2[s, at], e, bits, y_at[s, q])
            rates(x_at[s, q], k, y_at[s, q], slope[q])
        for q in range(4 if s < steps else 0):
            for i in range(x.shape[0]):
                for t in range(TILE):
                    x[i, t] += h[s, own + t] * WEIGHT[q] * slope[q, i, t]
    return total


@njit(fastmath=True)
def back(steps, own, h, rows, blend, layers, k, kept, xb, d_bias1, gradients, d_k):
    """The reverse pass of `solve`: xb [n, TILE] becomes the cotangent of the initial state."""
    x_at, y_at, arrivals, a1, d1, a2, d2 = kept
    value, mask, factor = rows
    sb, ob, yb = np.zeros((4, *xb.shape), xb.dtype), np.zeros_like(xb), np.zeros((4, TILE), xb.dtype)
    da = np.zeros((TILE, a1.shape[2]), xb.dtype)
    for s in range(steps, -1, -1):
        for i in range(xb.shape[0]):
            for t in range(TILE):
                off = arrivals[s, i, t] - value[s, own + t, i]
                xb[i, t] *= 1 - blend * mask[s, own + t, i]
                xb[i, t] += 2 * factor[s, own + t, i] * off
        if s == 0:
            break
        p = s - 1
        for q in range(3, -1, -1):
            for i in range(xb.shape[0]):
                for t in range(TILE):
                    later = AHEAD[q + 1] * sb[q + 1, i, t] if q < 3 else 0.0
                    ob[i, t] = h[p, own + t] * (WEIGHT[q] * xb[i, t] + later)
            at = slice(q * TILE, (q + 1) * TILE)
            rates_reverse(x_at[p, q], k, y_at[p, q], ob, sb[q], yb[q], d_k)
            reverse(yb[q], layers, d1[p, at], d2[p, at], da, sb[q])
        add_gradients(x_at[p], yb, a1[p], d1[p], a2[p], d2[p], d_bias1, gradients)
        for q in range(4):
            xb += sb[q]


@njit(fastmath=True)
def unroll(forward, h, condition, rows, blend, layers, k, start, gradients, d_k, d_start, e, bits):
    depth, width, n = h.shape[0], len(layers[1]), start.shape[1]
    x_at, y_at = np.zeros((depth, 4, n, TILE), h.dtype), np.zeros((depth, 4, TILE), h.dtype)
    a1, d1 = np.zeros((depth, 4 * TILE, width), h.dtype), np.zeros((depth, 4 * TILE, width), h.dtype)
    a2, d2 = np.zeros((depth, 4 * TILE, width), h.dtype), np.zeros((depth, 4 * TILE, width), h.dtype)
    kept = x_at, y_at, np.zeros((depth + 1, n, TILE), h.dtype), a1, d1, a2, d2
    bias1, d_bias1, first, d_first = (
        np.zeros((TILE, width), h.dtype),
        np.zeros((TILE, width), h.dtype),
        layers[0],
        gradients[0],
    )
    total = 0.0
    for own in range(0, h.shape[1], TILE):
        steps = depth
        while steps and h[steps - 1, own : own + TILE].max() == 0:
            steps -= 1
        for t in range(TILE):
            bias1[t] = layers[1] + first[2] * condition[own + t, 0]
        x, xb = start[own : own + TILE].T.copy(), np.zeros((n, TILE), h.dtype)
        total += solve(forward, steps, own, h, rows, blend, layers, bias1, k, x, kept, e, bits)
        d_bias1[:] = 0
        back(steps, own, h, rows, blend, layers, k, kept, xb, d_bias1, gradients, d_k)
        d_start[own : own + TILE] = xb.T
        for t in range(TILE):
            gradients[1][:] += d_bias1[t]
            d_first[2] += d_bias1[t] * condition[own + t, 0]
    return total


def _power_of_2(terms: int) -> list[float]:
    """Coefficients of 2^r, |r| <= 1/2, the highest first: its Taylor series."""
    made = [1.0]
    for i in range(1, terms):
        made.append(made[-1] * np.log(2.0) / i)
    return made[::-1]


def kernel(work: Workload, dtype: Any) -> Callable[[], tuple[float, list[Any]]]:
    """Loss and gradients; `dtype` is torch's. Raises ValueError if the width is not a multiple of four."""
    name = str(dtype).removeprefix("torch.")
    forward, real = _forward(name), np.dtype(name)
    (w1, b1), (w2, b2), (w3, b3) = work.layers
    if w2.shape[0] % 4:
        raise ValueError("the width must be a multiple of four")

    def array(a: Any) -> Any:
        return np.ascontiguousarray(a, dtype=real)

    def tiles(a: Any, axis: int) -> Any:
        """Pads trajectories along `axis` to whole tiles; those added have no steps or measurements."""
        room = [(0, 0)] * a.ndim
        room[axis] = (0, -work.size.trajectories % TILE)
        return array(np.pad(a, room))

    h, condition, start = tiles(work.h, 1), tiles(work.condition, 0), tiles(work.start, 0)
    rows = tuple(tiles(a, 1) for a in (work.value, work.mask, work.weight))
    first = w1 / work.input_scale
    layers = tuple(array(a) for a in (first.T, b1 - first @ work.input_center, w2, w2.T, b2, w3[0], b3))
    k = array([*work.constants, work.output_center[0], work.output_scale[0]])
    center, scale, e = array(work.input_center), array(work.input_scale), np.zeros(len(b1), real)
    bits = e.view(np.int32 if name == "float32" else np.int64)

    def run() -> tuple[float, list[Any]]:
        gradients = tuple(np.zeros_like(layers[i]) for i in (0, 1, 2, 4, 5, 6))
        d_k, d_start = np.zeros(2, real), np.zeros_like(start)
        blend = real.type(work.blend)
        total = unroll(forward, h, condition, rows, blend, layers, k, start, gradients, d_k, d_start, e, bits)
        d_first, d_b1, d_w2, d_b2, d_w3, d_b3 = gradients
        d_w1 = (d_first - center[:, None] * d_b1).T / scale
        return total, [d_w1, d_b1, d_w2, d_b2, d_w3[None], d_b3, d_k, d_start[: work.size.trajectories]]

    return run
