"""Errors of an export relative to the sizes of terms, by quantity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError


@dataclass(frozen=True)
class Quantity:
    """The largest error of a quantity, relative to the size of its terms, and the largest that is accepted."""

    name: str
    error: float
    accepted: float

    @property
    def agrees(self) -> bool:
        """Whether the error is accepted."""
        return self.error <= self.accepted


def compare(name: str, found: Array, known: tuple[Array, Array], accepted: float) -> Quantity:
    """The largest error where the module's value is finite."""
    values, sizes = known
    if not values.size:
        return Quantity(name, 0.0, accepted)
    finite = np.isfinite(values) & np.isfinite(sizes)
    with np.errstate(all="ignore"):
        errors = np.abs(found - values) / np.maximum(sizes, np.finfo(np.float64).tiny / np.finfo(np.float64).eps)
    errors = np.where(finite, np.where(np.isfinite(found), errors, np.inf), 0.0)
    return Quantity(name, float(errors.max()), accepted)


def require(form: str, quantities: Sequence[Quantity]) -> None:
    """Raises ComputationError that names what differs."""
    wrong = [each for each in quantities if not each.agrees]
    if wrong:
        listed = ", ".join(f"{each.name} by {each.error:.1e} (accepted: {each.accepted:.0e})" for each in wrong)
        raise ComputationError(
            f"the export as `{form}` differs from the generated module: {listed}, relative to the size of the terms",
            remedy="`--no-verify` writes it all the same; please report the model, since this is an error of gbspec",
        )
