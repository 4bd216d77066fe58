"""How well whole solutions follow a channel, by their R²: one definition for the warnings of a fit and its report."""

from __future__ import annotations

from typing import Literal

FOLLOWED, LOST = 0.9, 0.5
"""R² from which whole solutions follow a channel, and below which the fit is not to be relied on: they leave more than
half of the variance of its data."""


def how_followed(r2: float) -> Literal["well", "in part", "badly"]:
    """The same in words; an R² that is not a number is that of solutions that do not follow the data."""
    return "well" if r2 >= FOLLOWED else "in part" if r2 >= LOST else "badly"
