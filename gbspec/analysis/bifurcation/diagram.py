"""A bifurcation diagram: branches of steady states and of cycles over one parameter, as text and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import polars as pl

from gbspec.analysis.bifurcation.continuation import Branch, SpecialPoint
from gbspec.analysis.bifurcation.cycles import CycleBranch
from gbspec.analysis.bifurcation.limit_cycle import Cycle
from gbspec.arrays import Array
from gbspec.frames import Shown, of_rows


@dataclass(frozen=True, repr=False)
class Diagram(Shown):
    """A bifurcation diagram of `states` over `parameter` in `low`..`high`.

    `trained` is the parameter's trained (else plausible) range, None if unknown; `units` are those of the parameter and
    the states, by name, where they have any.
    """

    name: str
    parameter: str
    low: float
    high: float
    states: tuple[str, ...]
    branches: tuple[Branch, ...]
    special: tuple[SpecialPoint, ...]
    cycles: tuple[CycleBranch, ...]
    trained: tuple[float, float] | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    def to_frame(self) -> pl.DataFrame:
        """One row for each steady state, then for each cycle: `kind`, `branch`, the parameter, states, `stable`.

        A state of a cycle has its largest value there, and its smallest in NAME_min; `period` is the cycle's.
        """
        rows: list[dict[str, object]] = []
        for i, branch in enumerate(self.branches):
            for point in branch.points:
                at = {"kind": "steady", "branch": i, self.parameter: point.value}
                rows.append({**at, **self._named(point.state), "stable": point.stable})
        for i, family in enumerate(self.cycles):
            for one in family.cycles:
                low = {f"{name}_min": value for name, value in self._named(one.minimum).items()}
                extent = {**self._named(one.maximum), "stable": one.stable, **low, "period": one.period}
                rows.append({"kind": "cycle", "branch": i, self.parameter: one.value, **extent})
        return of_rows(rows)

    def of_kind(self, *kinds: str) -> tuple[SpecialPoint, ...]:
        """The special points of the given kinds, ordered by the parameter."""
        return tuple(point for point in self.special if point.kind in kinds)

    def drawn_at(self, point: SpecialPoint) -> Array:
        """The state [n] at which a special point is drawn: its own, or the largest values of its cycle."""
        if point.kind in ("cycle_fold", "period_doubling", "torus"):
            for kind, cycle in self.cycles[point.branch].found:
                if (kind, cycle.value) == (point.kind, point.value):
                    return cycle.maximum
        return point.state

    def to_json(self) -> dict[str, object]:
        """The document of `bifurcate --json`."""
        return {
            "parameter": self.parameter,
            "range": [self.low, self.high],
            "branches": [self._branch(branch) for branch in self.branches],
            "special": [self._special(point) for point in self.special],
            "cycles": [self._cycle(cycle, i) for i, branch in enumerate(self.cycles) for cycle in branch.cycles],
            "states": list(self.states),
            "trained": list(self.trained) if self.trained else None,
            "cycle_branches": [
                {"start": branch.start, "end": branch.end, "cycles": len(branch.cycles)} for branch in self.cycles
            ],
        }

    def _named(self, state: Array) -> dict[str, float]:
        return dict(zip(self.states, map(float, state), strict=True))

    def _branch(self, branch: Branch) -> dict[str, object]:
        points = [
            {
                "value": point.value,
                "state": self._named(point.state),
                "stable": point.stable,
                "eigenvalues": [[float(one.real), float(one.imag)] for one in point.eigenvalues],
                "outside": list(point.outside),
            }
            for point in branch.points
        ]
        return {"points": points, "ends": list(branch.ends)}

    def _special(self, point: SpecialPoint) -> dict[str, object]:
        return {
            "type": point.kind,
            "value": point.value,
            "state": self._named(point.state),
            "criticality": point.criticality,
            "period": point.period,
            "interval": None if point.interval is None else list(point.interval),
            "sd": point.sd,
            "frequency": point.frequency,
            "l1": point.l1,
            "branch": point.branch,
            "branches": list(point.branches),
        }

    def _cycle(self, cycle: Cycle, branch: int) -> dict[str, object]:
        return {
            "value": cycle.value,
            "period": cycle.period,
            "max": self._named(cycle.maximum),
            "min": self._named(cycle.minimum),
            "stable": cycle.stable,
            "multipliers": [[float(one.real), float(one.imag)] for one in cycle.multipliers],
            "branch": branch,
            "outside": list(cycle.outside),
        }

    def __str__(self) -> str:
        lines = [f"{self.name} over {self.parameter} from {self.low:.6g} to {self.high:.6g}"]
        for i, branch in enumerate(self.branches):
            stable = sum(point.stable for point in branch.points)
            beyond = sum(bool(point.outside) for point in branch.points)
            lines.append(
                f"  branch {i}: {len(branch.points)} steady states, {stable} stable"
                + (f", {beyond} outside of data or declared ranges" if beyond else "")
                + ("; closed" if branch.ends[0] == "closed" else f"; ends: {', '.join(branch.ends)}")
            )
        lines += [f"  {_describe(point, self.parameter, self.states)}" for point in self.special]
        for family in self.cycles:
            if family.cycles:
                values = [cycle.value for cycle in family.cycles]
                periods = [cycle.period for cycle in family.cycles]
                stable = sum(cycle.stable for cycle in family.cycles)
                lines.append(
                    f"  cycles from {family.start}: {len(values)}, {stable} stable, {self.parameter} "
                    f"{min(values):.6g} to {max(values):.6g}, period {min(periods):.6g} to {max(periods):.6g}; "
                    f"end: {family.end}"
                )
        return "\n".join(lines)


NAMES = {
    "fold": "fold",
    "nonsmooth_fold": "non-smooth fold",
    "hopf": "Hopf point",
    "branch": "branch point",
    "cycle_fold": "fold of cycles",
    "period_doubling": "period doubling",
    "torus": "torus bifurcation",
}


def _describe(point: SpecialPoint, parameter: str, states: Sequence[str]) -> str:
    text = NAMES[point.kind]
    if len(point.branches) > 1:
        text += " (of branches " + ", ".join(map(str, point.branches[:-1])) + f" and {point.branches[-1]})"
    text += f" at {parameter} = {point.value:.10g}"
    if point.interval is not None:
        text += f" [{point.interval[0]:.6g}, {point.interval[1]:.6g}]"
    if point.criticality is not None:
        text += f", {point.criticality}critical (l1 = {point.l1:.4g})"
    if point.period is not None:
        text += f", period {point.period:.8g}"
    return text + ": " + ", ".join(f"{name} = {value:.6g}" for name, value in zip(states, point.state, strict=True))
