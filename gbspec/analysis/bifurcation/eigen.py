"""Eigenvalues of the Jacobian at given points, along trajectories and at steady states, compared with the truth's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.systems import System, state_at, steady_states
from gbspec.arrays import Array, ComplexArray
from gbspec.diagnostics import Findings
from gbspec.frames import Tabled, of_rows

if TYPE_CHECKING:
    import polars as pl

    from gbspec.analysis.prediction import Prediction
    from gbspec.data import Trajectories


def _pairs(values: ComplexArray) -> list[list[float]]:
    return [[float(value.real), float(value.imag)] for value in values]


def _padded(point: EigenPoint) -> list[complex | None]:
    """The truth's eigenvalue beside each one; None where it has none, or fewer characteristic roots."""
    true = [] if point.truth is None else [complex(value) for value in point.truth]
    return [*true, *[None] * len(point.eigenvalues)][: len(point.eigenvalues)]


def format_eigenvalue(value: complex) -> str:
    """An eigenvalue as text: `-0.5`, `0.12 + 2.3i`."""
    if value.imag == 0.0:
        return f"{value.real:.5g}"
    return f"{value.real:.5g} {'+' if value.imag > 0 else '-'} {abs(value.imag):.5g}i"


@dataclass(frozen=True)
class EigenPoint:
    """The Jacobian's eigenvalues at one point, by decreasing real part, and the truth's at the same point.

    `kind` of the point: `given`; `data` (measured) or `predicted`, at `time` of the trajectory `trajectory`; or
    `steady`, a steady state of the model. `outside` names the quantities outside their trained (else plausible) ranges.
    `shares` [n, n] is the part of each state (column) in each mode (row), with states in units of their ranges.
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
    shares: Array | None = field(default=None, repr=False)

    def to_json(self) -> dict[str, object]:
        """Keys state, condition, rhs_norm, eigenvalues, truth, then the origin of the point."""
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


FAST = 3.0
"""A mode that decays to exp(-3), a twentieth, between two measurements counts as not visible in the second."""
PART = 0.5
"""A state belongs to a mode if its part in the eigenvector is at least this fraction of the largest one."""


@dataclass(frozen=True)
class FastMode:
    """A mode that decays between two measurements, so that the data could not determine it.

    `fastest` and `slowest` are the smallest and largest real part over the points; `decayed` is the time within which
    it falls to a twentieth even at the slowest. `states` are those that dominate its eigenvector, largest first.
    """

    rank: int
    fastest: float
    slowest: float
    states: tuple[str, ...] = ()

    @property
    def decayed(self) -> float:
        """The time within which the mode falls to a twentieth at every point."""
        return -FAST / self.slowest

    def to_json(self) -> dict[str, object]:
        """Rank (from 0, by decreasing real part), real parts, the time of decay and the states that dominate it."""
        return {
            "rank": self.rank,
            "fastest": self.fastest,
            "slowest": self.slowest,
            "decayed": self.decayed,
            "states": list(self.states),
        }

    def __str__(self) -> str:
        return f"mode {self.rank + 1}" + (f", of {', '.join(self.states)}" if self.states else "")


@dataclass(frozen=True, repr=False)
class Eigen(Tabled):
    """Eigenvalues at several points; `interval` is the median time between measurements, if there are data."""

    points: tuple[EigenPoint, ...] = field(default=())
    interval: float | None = None

    def to_frame(self) -> pl.DataFrame:
        """One row for each point and eigenvalue: `point`, its origin, states and conditions, `real` and `imaginary`.

        Eigenvalues are in 1 over the unit of time, by decreasing real part; `true_real` and `true_imaginary` are those
        of the truth.
        """
        return of_rows(
            {
                "point": number,
                "kind": point.kind,
                "trajectory": point.trajectory,
                "time": point.time,
                **point.state,
                **point.condition,
                "mode": mode,
                "real": float(value.real),
                "imaginary": float(value.imag),
                "true_real": None if true is None else float(true.real),
                "true_imaginary": None if true is None else float(true.imag),
            }
            for number, point in enumerate(self.points)
            for mode, (value, true) in enumerate(zip(point.eigenvalues, _padded(point), strict=True))
        )

    def summary(self) -> str:
        """The number of points."""
        return f"eigenvalues at {len(self.points)} point{'s' * (len(self.points) != 1)}"

    @property
    def fast_modes(self) -> tuple[FastMode, ...]:
        """The modes that decay between two measurements at every point; none without data."""
        if self.interval is None or not self.points:
            return ()
        known = min(len(point.eigenvalues) for point in self.points)  # of characteristic roots, not as many everywhere
        rates = np.array([point.eigenvalues.real[:known] for point in self.points])
        return tuple(
            FastMode(rank, float(column.min()), float(column.max()), self._states_of(rank))
            for rank, column in enumerate(rates.T)
            if column.max() * self.interval < -FAST
        )

    def _states_of(self, rank: int) -> tuple[str, ...]:
        """The states that dominate a mode in the mean over the points, largest part first."""
        parts = np.mean([point.shares[rank] for point in self.points if point.shares is not None], axis=0)
        names = list(self.points[0].state)
        return tuple(names[i] for i in np.argsort(-parts, kind="stable") if parts[i] >= PART * parts.max())

    def to_json(self) -> dict[str, object]:
        """The document of `eigen --json`: points, time between measurements, and the modes that decay within it."""
        return {
            "points": [point.to_json() for point in self.points],
            "interval": self.interval,
            "fast_modes": [mode.to_json() for mode in self.fast_modes],
        }

    def __str__(self) -> str:
        lines = [str(point) for point in self.points] or ["no points"]
        lines += [
            f"{mode} (real part {mode.fastest:.4g} to {mode.slowest:.4g}), decays within "
            f"{mode.decayed:.3g}, between two measurements ({self.interval:.3g} apart): the data could not determine it"
            for mode in self.fast_modes
        ]
        return "\n".join(lines)


def eigen_at(system: System, x: Array, truth: System | None = None, time: float | None = None) -> EigenPoint:
    """The eigenvalues at state `x` [n], conditions and inputs at the system's values; the truth's at the same ones."""
    f, _ = system.linearise(x, time)
    shared = {name: system.values[name] for name in (*system.conditions, *system.inputs)}
    values, vectors = system.modes(x, time)
    true = None if truth is None else truth.with_values(shared).spectrum(x, time)
    return EigenPoint(
        state=dict(zip(system.states, map(float, x), strict=True)),
        condition=shared,
        rhs_norm=float(np.linalg.norm(f)),
        eigenvalues=values,
        truth=true,
        outside=system.outside(x),
        shares=np.abs(vectors.T),
    )


def eigen(
    system: System,
    *,
    truth: System | None = None,
    at: Sequence[Mapping[str, float]] = (),
    along: Trajectories | None = None,
    predicted: Sequence[Prediction] = (),
    steady: bool = False,
    starts: int = 64,
) -> Eigen:
    """Eigenvalues at the points `at`, along measured trajectories, and at steady states.

    With `steady`, steady states are searched for at every entry of `at` (which then need not name states), else at the
    default of every condition, or at five values across the range of the one condition without a default. Along data,
    the points are the rows at which every state is measured as a channel of its own, or with `predicted` (one for each
    trajectory) all rows, at the predicted states where some state is not measured. Raises UserError
    for points with unknown or missing names (GB870, GB871), and for data that measure too little (GB874).
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
        points.extend(_along(system, along, predicted, truth))
    return Eigen(tuple(points), None if along is None else usual_interval(along))


def _settings(system: System, at: Sequence[Mapping[str, float]], findings: Findings) -> Iterable[System]:
    """The systems whose steady states are requested."""
    if at:
        settings = []
        for point in at:
            # The states of the point are not used, but their names are checked.
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


def usual_interval(data: Trajectories) -> float | None:
    """The median time between two rows of a trajectory; None if no trajectory has two."""
    intervals = np.concatenate([np.diff(item.times) for item in data.items])
    return float(np.median(intervals)) if len(intervals) else None


def _along(
    system: System, data: Trajectories, predicted: Sequence[Prediction], truth: System | None
) -> Iterable[EigenPoint]:
    """The rows of a table: the measured states where all states are measured, else the predicted ones."""
    missing = [name for name in system.states if name not in data.channels]
    if missing and not predicted:
        findings = Findings()
        names = ", ".join(f"`{name}`" for name in missing)
        findings.error(
            "GB874", f"the table does not measure {names}, so there are no points for eigenvalues", None,
            help="measure every state as a channel of its own, or give points with `--at`",
        )  # fmt: skip
        findings.raise_if_failed()
    for i, item in enumerate(data.items):
        moved = system.with_values(dict(zip(system.conditions, map(float, item.condition), strict=True)))
        measured = np.full((len(item.times), system.size), np.nan)
        if not missing:
            measured = item.values[:, [data.channels.index(name) for name in system.states]]
        solved = predicted[i].states if predicted else measured
        for row, time in enumerate(map(float, item.times)):
            seen = bool(np.isfinite(measured[row]).all())
            state = measured[row] if seen else solved[row]
            if np.isfinite(state).all():
                held = system.inputs_at(item.inputs, time)
                point = eigen_at(moved.with_values(held), state, truth, time)
                yield replace(point, kind="data" if seen else "predicted", trajectory=item.label, time=time)
