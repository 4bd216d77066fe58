"""JAX by hand: `lax.scan` over the packed sub-steps, plain or with each step rematerialised in the reverse pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.workload import Workload

Step = Callable[[], Any]


def parameters(work: Workload, dtype: Any) -> dict[str, Any]:
    """The learned parameters."""
    layers = [(jnp.asarray(w, dtype), jnp.asarray(b, dtype)) for w, b in work.layers]
    return {
        "layers": layers,
        "constants": jnp.asarray(work.constants, dtype),
        "start": jnp.asarray(work.start, dtype),
    }


def scales(work: Workload, dtype: Any) -> tuple[Any, ...]:
    arrays = (work.input_center, work.input_scale, work.output_center, work.output_scale)
    return tuple(jnp.asarray(a, dtype) for a in arrays)


def parts(gradient: dict[str, Any]) -> list[Any]:
    """A gradient's arrays in the workload's order."""
    return [*(a for layer in gradient["layers"] for a in layer), gradient["constants"], gradient["start"]]


def right_hand_side(p: dict[str, Any], fixed: tuple[Any, ...], condition: Any) -> Callable[[Any], Any]:
    """dx/dt of states [..., n] (the condition [..., 1] folded into the first layer's bias)."""
    center, scale, output_center, output_scale = fixed
    (w1, b1), *middle, (w3, b3) = p["layers"]
    B, beta = p["constants"]
    first = w1 / scale
    bias = b1 - first @ center + condition @ first[:, 2:].T

    def f(x: Any) -> Any:
        a = jax.nn.silu(bias + x[..., :2] @ first[:, :2].T)
        for w, b in middle:
            a = jax.nn.silu(a @ w.T + b)
        phi = output_center + output_scale * (a @ w3.T + b3)
        x1, x2, rest = x[..., :1], x[..., 1:2], x[..., 1:-1] - x[..., 2:]
        return jnp.concatenate([phi - x1, B * phi - (1 + beta) * x2, rest], axis=-1)

    return f


def scan(work: Workload, dtype: Any, checkpoint: bool) -> Step:
    """The step, compiled ahead of time; the loss is summed within the scan."""
    h, value, mask, weight = (jnp.asarray(a, dtype) for a in (work.h[..., None], work.value, work.mask, work.weight))
    condition, fixed = jnp.asarray(work.condition, dtype), scales(work, dtype)

    def loss(p: dict[str, Any], h: Any, value: Any, mask: Any, weight: Any, condition: Any) -> Any:
        f = right_hand_side(p, fixed, condition)

        def arrive(x: Any, value: Any, mask: Any, weight: Any) -> Any:
            deviation = x - value
            return x - work.blend * mask * deviation, (weight * deviation**2).sum()

        def body(carry: Any, row: Any) -> Any:
            x, total = carry
            h, *rest = row
            k1 = f(x)
            k2 = f(x + h / 2 * k1)
            k3 = f(x + h / 2 * k2)
            k4 = f(x + h * k3)
            x, part = arrive(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), *rest)
            return (x, total + part), None

        begin = arrive(p["start"], value[0], mask[0], weight[0])
        body = jax.checkpoint(body) if checkpoint else body
        (_, total), _ = jax.lax.scan(body, begin, (h, value[1:], mask[1:], weight[1:]))
        return total

    p = parameters(work, dtype)
    arguments = (p, h, value, mask, weight, condition)
    compiled = jax.jit(jax.value_and_grad(loss)).lower(*arguments).compile()
    return lambda: jax.block_until_ready(compiled(*arguments))


def plain(work: Workload, dtype: Any) -> Step:
    return scan(work, dtype, checkpoint=False)


def checkpointed(work: Workload, dtype: Any) -> Step:
    return scan(work, dtype, checkpoint=True)
