"""Types of numerical arrays, used throughout the package, and what is done with tables of measured values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]
"""Which entries count."""


def as_measured(values: Array, logs: Mask) -> Array:
    """Values [...] of which those at `logs` [...] are logarithms, all as they are measured."""
    return np.where(logs, np.exp(np.where(logs, values, 0.0)), values)
