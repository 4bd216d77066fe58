"""The memory of the torch graph for its backward pass, and checkpoint intervals for a graph that needs too much.

Only the states at the starts of the intervals are kept; the backward pass recomputes each interval from them. This
costs another forward pass and does not change the gradient. The intervals are as long as `GRAPH_BYTES` allows, so that,
apart from the states, the peak does not grow with the length of a trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

GRAPH_BYTES = 512 * 1024**2
"""A graph that needs more than this is cut into checkpoint intervals of at most this size."""
FEW = 5000
"""A graph with at most this many sub-steps, counted over all rows, is assumed to be small."""


def kept_bytes(function: Callable[[int], Tensor]) -> int:
    """Bytes that the graph of `function(n)` keeps per row of its batch of n rows, without those shared by all rows."""
    return _kept(lambda: function(2)) - _kept(lambda: function(1))


def _kept(function: Callable[[], Tensor]) -> int:
    sizes: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        sizes[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        whole = function()  # kept until all is counted, so that no freed storage is reused
    del whole
    return sum(sizes.values())


def checkpoint_intervals(live: Sequence[int], row_bytes: Callable[[], int]) -> list[tuple[int, int]]:
    """First and last (excluded) sub-steps of the intervals of a graph with `live` rows in each sub-step.

    `row_bytes` returns the memory of one sub-step of one row; it is called only if the graph may be too large. If there
    is one interval, the whole graph is kept.
    """
    steps = len(live)
    if sum(live) <= FEW:
        return [(0, steps)]
    grown = np.cumsum(live) * row_bytes()
    if grown[-1] <= GRAPH_BYTES:
        return [(0, steps)]
    out, begin, before = [], 0, 0
    while begin < steps:
        end = max(int(np.searchsorted(grown, before + GRAPH_BYTES, side="right")), begin + 1)
        out.append((begin, end))
        begin, before = end, int(grown[end - 1])
    return out
