"""Events in a packing: how near to the end of a sub-step they wait for the next one."""

from __future__ import annotations

from gbspec.training.problem.packing import Packed

BAND = 1e-10
"""Within this share of the longest step of its end a step leaves events to the next one, after what arrives there."""


def band_of(packed: Packed) -> float:
    """The time before the end of a sub-step within which events wait for the next one."""
    return BAND * packed.max_step
