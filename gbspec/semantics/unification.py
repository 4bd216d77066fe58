"""Infers undeclared units from use: linear equations in the exponents, solved one at a time.

Each name without a unit has an unknown. An equation `first = second` is reduced to the remaining unknowns and solved
for one of them. An equation without unknowns either holds or is a disagreement, which is reported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from fractions import Fraction

from gbspec.diagnostics import Span
from gbspec.semantics.units import Namespace, Unit

UNKNOWN = "an unknown unit"


@dataclass
class Solution:
    """The unknowns solved so far, and the place at which each was solved."""

    namespace: Namespace
    solved: dict[str, Unit] = field(default_factory=dict)
    origins: dict[str, Span] = field(default_factory=dict)
    _count: int = 0

    def fresh(self) -> Unit:
        """A new undetermined unit."""
        self._count += 1
        return self.of(f"?{self._count}")

    def of(self, name: str) -> Unit:
        """The unit of a name that declares none."""
        return Unit((), ((name, Fraction(1)),))

    def resolved(self, unit: Unit) -> Unit:
        """The unit with all solved unknowns substituted."""
        while any(name in self.solved for name, _ in unit.unknowns):
            result = Unit(unit.names)
            for name, exponent in unit.unknowns:
                value = self.solved.get(name)
                result = result.times(value if value is not None else self.of(name), exponent)
            unit = result
        return unit

    def equal(self, first: Unit, second: Unit, place: Span) -> bool:
        """Makes two units equal if possible; False if both are known and differ."""
        ratio = self.resolved(first.times(second, Fraction(-1)))
        if not ratio.unknowns:
            return self.namespace.is_one(ratio)
        name, exponent = self._choose(ratio.unknowns)
        rest = Unit(ratio.names, tuple(pair for pair in ratio.unknowns if pair[0] != name))
        self.solved[name] = rest.power(-1 / exponent)
        self.origins[name] = place
        return True

    @staticmethod
    def _choose(unknowns: Iterable[tuple[str, Fraction]]) -> tuple[str, Fraction]:
        """The unknown to solve for: preferably that of an intermediate value, not of a name."""
        return min(unknowns, key=lambda pair: (not pair[0].startswith("?"), pair[0]))

    def known(self, unit: Unit) -> Unit | None:
        """The unit with solved unknowns substituted; None if unknowns remain."""
        unit = self.resolved(unit)
        return unit if not unit.unknowns else None

    def shown(self, unit: Unit) -> str:
        """The unit for a message."""
        unit = self.resolved(unit)
        parts = [str(Unit(unit.names))] if unit.names or not unit.unknowns else []
        parts += [
            f"(unit of {name})^{exponent}" if exponent != 1 else f"(unit of {name})"
            for name, exponent in unit.unknowns
            if not name.startswith("?")
        ]
        return "*".join(parts) or UNKNOWN


def factor_between(first: Unit, second: Unit, namespace: Namespace) -> float | None:
    """The conversion factor `first`/`second`; None if the units have different dimensions."""
    measure = namespace.measure(first.times(second, Fraction(-1)))
    return None if measure.dimensions else measure.factor
