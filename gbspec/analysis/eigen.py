"""Eigenvalues of the Jacobian: at given points, along trajectories, at steady states; beside the truth's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gbspec.analysis.steady import ordered_eigenvalues, steady_states
from gbspec.analysis.system import System, state_at
from gbspec.diagnostics import Findings

if TYPE_CHECKING:
    from gbspec.data.trajectories import Trajectories

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def _pairs(values: ComplexArray) -> list[list[float]]:
    return [[float(value.real), float(value.imag)] for value in values]


def format_eigenvalue(value: complex) -> str:
    """An eigenvalue as people write it: `-0.5`, `0.12 + 2.3i`."""
    if value.imag == 0.0:
        return f"{value.real:.5g}"
    return f"{value.real:.5g} {'+' if value.imag > 0 else '-'} {abs(value.imag):.5g}i"


@dataclass(frozen=True)
class EigenPoint:
    """The Jacobian's eigenvalues at one point, by falling real part, and the truth's at the same point.

    `kind` says what the point is: given, on a trajectory (`trajectory` and `time` say where), or a steady state of the
    model. `outside` names what lies outside of its plausible or trained range there.
    """

    state: Mapping[str, float]
    condition: Mapping[str, float]
    rhs_norm: float
    eigenvalues: ComplexArray
    truth: ComplexArray | None = None
    kind: str = "given"
    trajectory: str | None = None
    time: float | None = None
    outside: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Keys state, condition, rhs_norm, eigenvalues, truth, then where the point comes from."""
        document: dict[str, object] = {
            "state": dict(self.state),
            "condition": dict(self.condition),
            "rhs_norm": self.rhs_norm,
            "eigenvalues": _pairs(self.eigenvalues),
            "truth": None if self.truth is None else _pairs(self.truth),
            "kind": self.kind,
        }
        if self.trajectory is not None:
            document |= {"trajectory": self.trajectory, "time": self.time}
        return document | {"outside": list(self.outside)}

    def __str__(self) -> str:
        where = ", ".join(f"{name} = {value:.6g}" for name, value in {**self.state, **self.condition}.items())
        head = self.kind if self.trajectory is None else f"{self.trajectory}, t = {self.time:.6g}"
        lines = [f"{head}: {where}   |rhs| = {self.rhs_norm:.3g}"]
        lines.append("  eigenvalues  " + "   ".join(map(format_eigenvalue, self.eigenvalues)))
        if self.truth is not None:
            lines.append("  truth        " + "   ".join(map(format_eigenvalue, self.truth)))
        if self.outside:
            lines.append("  outside of its range: " + ", ".join(self.outside))
        return "\n".join(lines)


@dataclass(frozen=True)
class Eigen:
    """Eigenvalues at several points."""

    points: tuple[EigenPoint, ...] = field(default=())

    def to_json(self) -> dict[str, object]:
        """The document of `eigen --json`."""
        return {"points": [point.to_json() for point in self.points]}

    def __str__(self) -> str:
        return "\n".join(map(str, self.points)) or "no points"


def eigen_at(system: System, x: Array, truth: System | None = None, time: float | None = None) -> EigenPoint:
    """The eigenvalues at state `x` [n], conditions and inputs at the system's values; the truth's at the same ones."""
    f, jacobian = system.linearise(x, time)
    shared = {name: system.values[name] for name in (*system.conditions, *system.inputs)}
    true = None
    if truth is not None:
        _, true_jacobian = truth.with_values(shared).linearise(x, time)
        true = ordered_eigenvalues(true_jacobian)
    return EigenPoint(
        state=dict(zip(system.states, map(float, x), strict=True)),
        condition=shared,
        rhs_norm=float(np.linalg.norm(f)),
        eigenvalues=ordered_eigenvalues(jacobian),
        truth=true,
        outside=system.outside(x),
    )


def eigen(
    system: System,
    *,
    truth: System | None = None,
    at: Sequence[Mapping[str, float]] = (),
    along: Trajectories | None = None,
    steady: bool = False,
    starts: int = 64,
) -> Eigen:
    """Eigenvalues at the points `at`, along measured trajectories, and at steady states.

    With `steady`, steady states are sought at every entry of `at` (which then need name no states), else at the
    default of every condition, or at five values across the range of the one condition without a default. Along data,
    the points are the rows at which every state is measured as a channel of its own. Raises UserError for points that
    name what the model does not have or leave out what it needs (GB870, GB871).
    """
    findings = Findings()
    points: list[EigenPoint] = []
    if steady:
        for moved in _settings(system, at, findings):
            for found in steady_states(moved, starts=starts):
                points.append(replace(eigen_at(moved, found.state, truth), kind="steady"))
    else:
        for given in at:
            place = state_at(system, given, findings)
            if place is not None:
                points.append(eigen_at(*place, truth))
    findings.raise_if_failed()
    if along is not None:
        points.extend(_along(system, along, truth))
    return Eigen(tuple(points))


def _settings(system: System, at: Sequence[Mapping[str, float]], findings: Findings) -> Iterable[System]:
    """The systems whose steady states are asked for."""
    if at:
        settings = []
        for point in at:
            # The states of the point do not matter here, but a misspelt name does.
            states = {name: point.get(name, 0.0) for name in system.states}
            place = state_at(system, {**states, **point}, findings)
            if place is not None:
                settings.append(place[0])
        return settings
    if len(system.missing) == 1:
        low, high = system.range(system.missing[0])
        if np.isfinite(low) and np.isfinite(high):
            return [system.with_values({system.missing[0]: value}) for value in np.linspace(low, high, 5)]
    return [system]


def _along(system: System, data: Trajectories, truth: System | None) -> Iterable[EigenPoint]:
    """The rows of a table at which every state is measured."""
    findings = Findings()
    missing = [name for name in system.states if name not in data.channels]
    if missing:
        names = ", ".join(f"`{name}`" for name in missing)
        findings.error(
            "GB874", f"the table does not measure {names}, so it gives no points to take eigenvalues at", None,
            help="measure every state as a channel of its own, or give points with `--at`",
        )  # fmt: skip
        findings.raise_if_failed()
    columns = [data.channels.index(name) for name in system.states]
    for item in data.items:
        moved = system.with_values(dict(zip(system.conditions, map(float, item.condition), strict=True)))
        rows = item.values[:, columns]
        for i in np.flatnonzero(np.isfinite(rows).all(axis=1)):
            time = float(item.times[i])
            held = {
                name: float(np.interp(time, signal.times, signal.values))
                for name, signal in zip(system.inputs, item.inputs, strict=True)
            }
            point = eigen_at(moved.with_values(held), rows[i], truth, time)
            yield replace(point, kind="data", trajectory=item.label, time=time)
