"""Passes over a Model: the truth put in, values overridden, conservation laws."""

from gbspec.passes.override import with_values
from gbspec.passes.truth import with_truth

__all__ = ["with_truth", "with_values"]
