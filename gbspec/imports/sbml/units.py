"""Units of SBML as texts of the language: products of powers of pint's units, with prefixes or numbers."""

from __future__ import annotations

import math

import libsbml

from gbspec.imports.formulas import spelled_number
from gbspec.imports.sbml.reading import Element

_KINDS = {
    "ampere": "A", "becquerel": "Bq", "candela": "cd", "coulomb": "C", "farad": "F", "gram": "g", "gray": "Gy",
    "henry": "H", "hertz": "Hz", "item": "item", "joule": "J", "katal": "kat", "kelvin": "K", "litre": "L",
    "liter": "L", "lumen": "lm", "lux": "lx", "metre": "m", "meter": "m", "mole": "mol", "newton": "N", "ohm": "ohm",
    "pascal": "Pa", "radian": "rad", "second": "s", "siemens": "S", "sievert": "Sv", "steradian": "sr", "tesla": "T",
    "volt": "V", "watt": "W", "weber": "Wb", "Celsius": "degC",
}  # fmt: skip
_PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "u", -3: "m", -2: "c", -1: "d", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
_TIMES = {60.0: "min", 3600.0: "h", 86400.0: "day"}


_LEVEL_2 = {"substance": "mol", "volume": "L", "area": "m^2", "length": "m", "time": "s"}
"""The units of Level 2 that a model may define again."""


# libsbml derives units too, but ends the process for some malformed ones.
def unit_of(element: Element) -> str | None:
    """The unit of a parameter or a compartment; None if the file does not give it, or the language cannot hold it."""
    model = element.getModel()
    if element.getUnits():
        return _named(model, element.getUnits())
    if element.getElementName() != "compartment":
        return None
    dimensions = element.getSpatialDimensionsAsDouble()
    kind = {3.0: "volume", 2.0: "area", 1.0: "length"}.get(dimensions)
    if kind is None:
        return None
    if model.getLevel() < 3:
        return _named(model, kind)
    asked = {"volume": model.getVolumeUnits, "area": model.getAreaUnits, "length": model.getLengthUnits}
    return _named(model, asked[kind]())


def species_unit(species: Element, amount: bool) -> str | None:
    """The unit of a species' symbol: of an amount, or of a concentration."""
    model = species.getModel()
    name = species.getSubstanceUnits() or ("substance" if model.getLevel() < 3 else model.getSubstanceUnits())
    substance = _named(model, name)
    compartment = model.getCompartment(species.getCompartment())
    if amount or substance is None or compartment is None:
        return substance
    size = unit_of(compartment)
    if size is None:
        return None
    return f"{substance}/{size}" if size.isalnum() else f"{substance}/({size})"


def time_unit(model: Element) -> str | None:
    """The unit of time."""
    return _named(model, "time" if model.getLevel() < 3 else model.getTimeUnits())


def _named(model: Element, name: str) -> str | None:
    """The unit of a name: of a definition, of Level 2, or of SBML itself."""
    own = model.getUnitDefinition(name)
    if own is not None:
        return text_of(own)
    return _LEVEL_2.get(name) if model.getLevel() < 3 and name in _LEVEL_2 else _KINDS.get(name)


def text_of(definition: Element) -> str | None:
    """A unit's text."""
    if definition is None or definition.getNumUnits() == 0:
        return None
    above: list[str] = []
    below: list[str] = []
    for i in range(definition.getNumUnits()):
        unit = definition.getUnit(i)
        found = _factor(unit)
        if found is None:
            return None
        exponent = unit.getExponentAsDouble()
        if not math.isfinite(exponent):
            return None
        if found and exponent:
            size = abs(exponent)
            (above if exponent > 0 else below).append(found if size == 1 else f"{found}^{_power(size)}")
    text = "*".join(above) or "1"
    text += "".join(f"/{part}" for part in below)
    return text


def _power(exponent: float) -> str:
    return spelled_number(exponent) if exponent == int(exponent) else f"({spelled_number(exponent)})"


def _factor(unit: Element) -> str | None:
    """One unit without its exponent; empty for a pure number of size 1."""
    kind, scale, multiplier = libsbml.UnitKind_toString(unit.getKind()), unit.getScale(), unit.getMultiplier()
    if kind == "kilogram":
        kind, scale = "gram", scale + 3
    if abs(scale) > 300 or not 0 < multiplier * 10.0**scale < float("inf"):
        return None
    size = multiplier * 10.0**scale
    if kind == "dimensionless":
        return "" if size == 1 else spelled_number(size)
    name = _KINDS.get(kind)
    if name is None:
        return None
    if kind == "second" and size in _TIMES:
        return _TIMES[size]
    if multiplier == 1 and scale in _PREFIXES and (kind not in ("item", "Celsius") or not scale):
        return _PREFIXES[scale] + name
    return f"({spelled_number(size)}*{name})"
