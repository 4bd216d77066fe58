"""Units of variables in terms of the base units of the SI, by which importing tools convert them."""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pint

SYMBOLS = {
    "kilogram": "kg", "meter": "m", "second": "s", "ampere": "A", "kelvin": "K", "mole": "mol", "candela": "cd",
    "radian": "rad",
}  # fmt: skip
"""FMI's names of the base units, by those of pint."""


@cache
def _registry() -> pint.UnitRegistry[float]:
    import pint

    return pint.UnitRegistry(cache_folder=None)


def base_unit(text: str) -> dict[str, str] | None:
    """The attributes of a unit's `BaseUnit`: exponents, and the factor; None for one that is not of the SI.

    Those are units that a model declares itself, units with an offset, and fractional powers.
    """
    import pint

    try:
        quantity = _registry().Quantity(1.0, text)
        if not quantity._is_multiplicative:
            return None
        based = quantity.to_base_units()
    except (pint.PintError, AttributeError, TypeError, ValueError, SyntaxError):
        return None
    found: dict[str, str] = {}
    for name, exponent in based.unit_items():
        power = Fraction(str(exponent))
        if name not in SYMBOLS or power.denominator != 1:
            return None
        found[SYMBOLS[name]] = str(power)
    if based.magnitude != 1.0:
        found["factor"] = repr(float(based.magnitude))
    return found
