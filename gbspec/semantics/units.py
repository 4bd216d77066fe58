"""The algebra of units: products of powers of named units, compared through pint; in a separate namespace.

Two units agree if they are equal, prefix included: `mg/L` is not `g/L`. Names that a model declares with `unit` are
independent base units, and so are units with an offset (`degC` is not `K`). pint is imported when a unit occurs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from typing import TYPE_CHECKING

from gbspec.diagnostics import Findings
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import ast

if TYPE_CHECKING:
    import pint

Powers = tuple[tuple[str, Fraction], ...]
"""Names with their exponents, sorted, none of them 0."""

DELTA = "delta_"
"""What pint writes before a unit of a scale with a zero of its own (`degC`) for differences, which are in kelvins."""

EQUAL = 1e-9
"""Relative difference up to which two factors are the same."""


def powers(table: Mapping[str, Fraction]) -> Powers:
    """The canonical form of a product."""
    return tuple(sorted((name, exponent) for name, exponent in table.items() if exponent))


@dataclass(frozen=True)
class Unit:
    """A product of powers of named units (numbers such as `1000` count as names), times powers of unknown units."""

    names: Powers = ()
    unknowns: Powers = ()

    def times(self, other: Unit, exponent: Fraction = Fraction(1)) -> Unit:
        """`self * other^exponent`."""
        return Unit(_combined(self.names, other.names, exponent), _combined(self.unknowns, other.unknowns, exponent))

    def power(self, exponent: Fraction) -> Unit:
        """`self^exponent`."""
        return ONE.times(self, exponent)

    def lone(self) -> str | None:
        """The name of a unit that is one name to the power 1."""
        return self.names[0][0] if len(self.names) == 1 and self.names[0][1] == 1 and not self.unknowns else None

    def __str__(self) -> str:
        return _text(self.names) or "1"


def _combined(first: Powers, second: Powers, exponent: Fraction) -> Powers:
    if not second:
        return first
    table = dict(first)
    for name, value in second:
        table[name] = table.get(name, Fraction(0)) + exponent * value
    return powers(table)


ONE = Unit()


def _text(names: Powers) -> str:
    if len(names) > 1 or any(exponent != 1 for _, exponent in names):
        names = tuple((name.removeprefix(DELTA), exponent) for name, exponent in names)
    above = [_power(name, exponent) for name, exponent in names if exponent > 0]
    below = [_power(name, -exponent) for name, exponent in names if exponent < 0]
    text = "*".join(above) or ("1" if below else "")
    return text + "".join(f"/{part}" for part in below)


def _power(name: str, exponent: Fraction) -> str:
    """A power as it is written in a model, where exponents are numbers, and near enough to be read as this one."""
    if exponent == 1:
        return name
    return f"{name}^{exponent}" if exponent.denominator == 1 else f"{name}^{float(exponent):.9g}"


# ---------------------------------------------------------------------------------------------------- measures of units


@cache
def _registry() -> pint.UnitRegistry[float]:
    import pint

    return pint.UnitRegistry(cache_folder=None)


@dataclass(frozen=True)
class Measure:
    """A unit in terms of base dimensions: its dimension and its size."""

    factor: float
    dimensions: Powers


@dataclass
class Namespace:
    """Units of a model: those it declares, then pint's."""

    own: frozenset[str]
    _measures: dict[str, Measure | None] = field(default_factory=dict)
    told: set[str] = field(default_factory=set)
    """Names that were reported: one mistake is one diagnostic, however often the name is used."""

    def atom(self, name: str) -> Measure | None:
        """The measure of one named unit; None if there is no such unit."""
        if name not in self._measures:
            self._measures[name] = self._find(name)
        return self._measures[name]

    def _find(self, name: str) -> Measure | None:
        if name in self.own:
            return Measure(1.0, ((f"unit {name}", Fraction(1)),))
        if name[0].isdigit() or name[0] == ".":
            size = float(name)
            return Measure(size, ()) if 0 < size < math.inf else None
        registry = _registry()
        if name not in registry:
            return None
        unit = registry.Unit(name)
        quantity = registry.Quantity(1.0, unit)
        if not quantity._is_multiplicative:
            return Measure(1.0, ((f"unit {unit}", Fraction(1)),))
        base = quantity.to_base_units()
        exponents = {str(k): float(str(v)) for k, v in quantity.dimensionality.items()}
        dimensions = {name: Fraction(value).limit_denominator(1000) for name, value in exponents.items()}
        return Measure(float(base.magnitude), powers(dimensions))

    def is_scale(self, name: str | None) -> bool:
        """Whether a unit has a zero of its own, as `degC` has."""
        atom = self.atom(name) if name is not None and name not in self.own else None
        return atom is not None and any(dimension.startswith("unit ") for dimension, _ in atom.dimensions)

    def difference(self, unit: Unit) -> Unit:
        """The unit of a difference of two values in this unit: another one for scales with a zero of their own."""
        name = unit.lone()
        return Unit(((f"{DELTA}{name}", Fraction(1)),)) if name is not None and self.is_scale(name) else unit

    def in_products(self, unit: Unit) -> Unit:
        """The unit with differences in place of scales with a zero of their own: `W/degC` is `W/K`."""
        if unit.lone() is not None:
            return unit
        names = tuple((DELTA + name if self.is_scale(name) else name, exponent) for name, exponent in unit.names)
        return Unit(powers(dict(names)), unit.unknowns)

    def moved(self, found: Unit, wanted: Unit) -> tuple[float, float] | None:
        """Factor and summand between two scales of temperature; None if these are no such units."""
        first, second = found.lone(), wanted.lone()
        if first is None or second is None or not {first, second}.isdisjoint(self.own):
            return None
        if not (self.is_scale(first) or self.is_scale(second)):
            return None
        registry = _registry()
        try:
            zero, one = (float(registry.Quantity(x, registry.Unit(first)).to(second).magnitude) for x in (0.0, 1.0))
        except Exception:  # units of different kinds; pint's errors have no common class that it exports
            return None
        return one - zero, zero

    def measure(self, unit: Unit) -> Measure:
        """The measure of a unit whose parts are all known.

        Where differences occur in it, a scale with a zero of its own counts as one too: they agree with both.
        """
        factor = 1.0
        dimensions: dict[str, Fraction] = {}
        differs = any(name.startswith(DELTA) for name, _ in unit.names)
        for given, exponent in unit.names:
            name = f"{DELTA}{given}" if differs and self.is_scale(given) else given
            atom = self.atom(name)
            if atom is not None:
                factor *= _raised(atom.factor, float(exponent))
                for dimension, power in atom.dimensions:
                    dimensions[dimension] = dimensions.get(dimension, Fraction(0)) + exponent * power
        return Measure(factor, powers(dimensions))

    def mixed(self, unit: Unit) -> tuple[str, str] | None:
        """Two units of one quantity in a unit, one above and one below the line, which differ by a factor."""
        known = [(name, exponent, self.atom(name)) for name, exponent in unit.names if not name[0].isdigit()]
        for name, exponent, atom in known:
            for other, power, second in known:
                if atom is None or second is None or exponent < 0 or power > 0 or not atom.dimensions:
                    continue
                same = atom.dimensions == second.dimensions
                if same and not math.isclose(atom.factor, second.factor, rel_tol=EQUAL):
                    return name, other
        return None

    def is_one(self, unit: Unit) -> bool:
        """Whether a known unit equals 1, prefixes included."""
        if not unit.names:
            return True
        measure = self.measure(unit)
        return not measure.dimensions and math.isclose(measure.factor, 1.0, rel_tol=EQUAL)

    def known(self) -> Iterable[str]:
        """The names to suggest for a misspelt unit."""
        return [*self.own, *(name for name in dir(_registry()) if name.isidentifier() and not name.startswith("_"))]


def read(unit: ast.UnitExpression, namespace: Namespace, findings: Findings) -> Unit | None:
    """The unit of a unit expression; None, with a diagnostic (GB501), if a name in it is not a unit."""
    result, sound = ONE, True
    stack: list[tuple[ast.UnitExpression, Fraction]] = [(unit, Fraction(1))]
    while stack:
        node, exponent = stack.pop()
        match node:
            case ast.UnitBinary(operator="^", left=left, right=right):
                stack.append((left, exponent * _exponent(right)))
            case ast.UnitBinary(operator=operator, left=left, right=right):
                stack.append((left, exponent))
                stack.append((right, -exponent if operator == "/" else exponent))
            case ast.UnitNumber(text=text):
                if namespace.atom(text) is None:
                    sound = False
                    _no_size(node, findings)
                elif float(text) != 1:
                    result = result.times(Unit(((text, Fraction(1)),)), exponent)
            case ast.UnitName(text=text):
                if namespace.atom(text) is None:
                    sound = False
                    if text not in namespace.told:
                        namespace.told.add(text)
                        _unknown(node, namespace, findings)
                else:
                    result = result.times(Unit(((text, Fraction(1)),)), exponent)
    return namespace.in_products(result) if sound else None


def _exponent(node: ast.UnitExpression) -> Fraction:
    return Fraction(node.text).limit_denominator(1000) if isinstance(node, ast.UnitNumber) else Fraction(1)


def _unknown(node: ast.UnitName, namespace: Namespace, findings: Findings) -> None:
    findings.error(
        "GB501",
        f"there is no unit `{node.text}`",
        node.span,
        help=suggestion(node.text, namespace.known()) or f"declare it as a new base unit: `unit {node.text}`",
        subject=node.text,
    )


def _no_size(node: ast.UnitNumber, findings: Findings) -> None:
    """A number that is no size of a unit: zero, or beyond the smallest or largest number."""
    findings.error(
        "GB501",
        f"a unit cannot have the size {node.text}",
        node.span,
        help="a pure number has the unit `1`; `1000*m` and `km` are the same unit",
        subject=node.text,
    )


def _raised(factor: float, exponent: float) -> float:
    """A factor to an exponent; infinite beyond the largest number."""
    try:
        return float(factor**exponent)
    except OverflowError:
        return math.inf
