"""Units that are not declared, found from use: linear equations over exponents, solved as they come.

Each name without a unit has an unknown. An equation `first = second` is put in terms of what is still unknown; one of
these is then solved for. An equation without unknowns either holds or is the disagreement that is reported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from fractions import Fraction

from gbspec.diagnostics import Span
from gbspec.semantics.units import Namespace, Unit


@dataclass
class Solution:
    """What the unknowns are so far, and where each was settled."""

    namespace: Namespace
    solved: dict[str, Unit] = field(default_factory=dict)
    origins: dict[str, Span] = field(default_factory=dict)
    _count: int = 0

    def fresh(self) -> Unit:
        """A unit that nothing is known of."""
        self._count += 1
        return self.of(f"?{self._count}")

    def of(self, name: str) -> Unit:
        """The unit of a name that declares none."""
        return Unit((), ((name, Fraction(1)),))

    def resolved(self, unit: Unit) -> Unit:
        """The unit with everything put in that is known by now."""
        while any(name in self.solved for name, _ in unit.unknowns):
            result = Unit(unit.names)
            for name, exponent in unit.unknowns:
                value = self.solved.get(name)
                result = result.times(value if value is not None else self.of(name), exponent)
            unit = result
        return unit

    def equal(self, first: Unit, second: Unit, place: Span) -> bool:
        """Makes two units equal if they can be; False where they are known and differ."""
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
        """Which unknown to solve for: one that stands for an intermediate value before one that has a name."""
        return min(unknowns, key=lambda pair: (not pair[0].startswith("?"), pair[0]))

    def known(self, unit: Unit) -> Unit | None:
        """The unit if nothing in it is unknown."""
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
        return "*".join(parts) or "an unknown unit"


def factor_between(first: Unit, second: Unit, namespace: Namespace) -> float | None:
    """How many of `second` one `first` is; None where they measure different things."""
    measure = namespace.measure(first.times(second, Fraction(-1)))
    return None if measure.dimensions else measure.factor
