"""How much the torch graph keeps for its backward pass, and in which parts it is kept where that is too much.

A part that is not kept is computed again, from the states at its start, when the backward pass comes to it; that costs
another forward pass and leaves the gradient as it is. The parts are as long as `GRAPH_BYTES` allows, so that the peak
does not grow with the length of a trajectory, but for the states themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

GRAPH_BYTES = 512 * 1024**2
"""A graph that would keep more than this is kept in parts of at most this size."""
FEW = 5000
"""A graph of no more sub-steps than this, counted over all pieces, is taken to be small."""


def kept_bytes(function: Callable[[int], Tensor]) -> int:
    """Bytes that the graph of `function(n)` keeps for each of the n rows of its batch, what all rows share left out."""
    return _kept(lambda: function(2)) - _kept(lambda: function(1))


def _kept(function: Callable[[], Tensor]) -> int:
    sizes: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        sizes[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.enable_grad(), torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        whole = function()  # held until all is counted, so that no storage takes the place of another
    del whole
    return sum(sizes.values())


def parts(live: Sequence[int], row_bytes: Callable[[], int]) -> list[tuple[int, int]]:
    """First and last (excluded) sub-steps of the parts of a graph with `live` rows in each sub-step.

    `row_bytes`, what a row's sub-step keeps, is asked for only where the graph may be too large. One part: it is kept.
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
