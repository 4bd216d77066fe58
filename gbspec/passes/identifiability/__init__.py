"""Structural identifiability: learnable constants and unknown functions that no data can separate."""

from gbspec.passes.identifiability.report import Identifiability, Inseparable, identifiability

__all__ = ["Identifiability", "Inseparable", "identifiability"]
