"""Which learnable constants and unknown functions no data could separate, decided before there are any data."""

from gbspec.passes.identifiability.report import Identifiability, Inseparable, identifiability

__all__ = ["Identifiability", "Inseparable", "identifiability"]
