"""Starts in a steady state for batches of trajectories, differentiable, as the generated module finds them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends.module.template.steady import _steady_start
from gbspec.backends.protocol import GeneratedModule, Networks

FoundStarts: TypeAlias = tuple[Array, Array, dict[int, tuple[int, str]]]
"""Steady states [N, s], the Jacobians of their rates, and the state and the reason where there is none."""
SearchStarts: TypeAlias = Callable[[Networks], FoundStarts]


def steady_starts(
    module: GeneratedModule,
    start: Tensor,
    condition: Tensor,
    inputs: Tensor,
    constants: Sequence[Tensor],
    networks: Networks,
    search: Callable[[SearchStarts], FoundStarts] | None = None,
) -> tuple[Tensor, dict[int, tuple[str, str]]]:
    """Starts [N, n_states] with steady states inserted, NaN where there is none, with the state and the reason.

    `search(run)` returns what `run(networks)` finds, or found before.
    """
    found, failed = _steady_start(
        module.equations, module.arithmetic("torch"), start, condition, inputs, tuple(constants), networks, search
    )
    places = module.equations.steady_states
    return found, {row: (module.states[places[place]], reason) for row, (place, reason) in failed.items()}
