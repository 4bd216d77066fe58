"""Units of a model as unit definitions."""

from __future__ import annotations

import re
from typing import Any

from gbspec.exports.fmi import base_unit

_KINDS = {
    "kg": "kilogram", "m": "metre", "s": "second", "A": "ampere", "K": "kelvin", "mol": "mole", "cd": "candela",
    "rad": "radian",
}  # fmt: skip


class Units:
    """The unit definitions of one model, each made when it is first needed."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._made: dict[str, str] = {}
        self.left_out: dict[str, None] = {}
        """Units that are none of the SI: those that a model declares itself, and those with an offset."""

    def of(self, text: str | None) -> str:
        """The id of a unit; empty where there is none."""
        if not text:
            return ""
        if text not in self._made:
            self._made[text] = self._defined(text)
        return self._made[text]

    def _defined(self, text: str) -> str:
        parts = base_unit(text)
        if parts is None:
            self.left_out[text] = None
            return ""
        factor = float(parts.pop("factor", 1.0))
        if not parts and factor == 1.0:
            return "dimensionless"
        definition = self._model.createUnitDefinition()
        name = "unit_" + (re.sub(r"\W+", "_", text.replace("/", "_per_"), flags=re.ASCII).strip("_") or "x")
        while self._model.getUnitDefinition(name) is not None:
            name += "_"
        definition.setId(name)
        definition.setName(text)
        if factor != 1.0 or not parts:
            _unit(definition, "dimensionless", 1, factor)
        for symbol, exponent in parts.items():
            _unit(definition, _KINDS[symbol], int(exponent), 1.0)
        return name


def _unit(definition: Any, kind: str, exponent: int, multiplier: float) -> None:
    import libsbml

    one = definition.createUnit()
    one.setKind(libsbml.UnitKind_forName(kind))
    one.setExponent(exponent)
    one.setScale(0)
    one.setMultiplier(multiplier)
