"""Passes over a Model: substituting the truth, overriding values, laws and claims, contracts, identifiability.

The names are imported on first use, since `gbspec check` of a model needs only some of the passes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gbspec.passes.override import with_values
    from gbspec.passes.truth import with_truth

__all__ = ["with_truth", "with_values"]


def __getattr__(name: str) -> Any:
    if name == "with_truth":
        from gbspec.passes.truth import with_truth

        return with_truth
    if name == "with_values":
        from gbspec.passes.override import with_values

        return with_values
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
