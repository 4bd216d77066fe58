"""Comparison of initial states: learned in training, bred, and true, along fast and slow directions.

Under teacher forcing, the learned initial states only have to fit the first rows. Bred initial states are those from
which the learned dynamics, kept fixed, fit the whole trajectory best; true ones are those from which the truth does.
Differences are decomposed into the modes of the Jacobian at the initial state: an error along a fast direction decays
before it is measured, so that the data hardly determine it, while an error along a slow direction persists.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.estimate import Estimator
from gbspec.analysis.prediction.solutions import learned_positions, learned_start, measured_start, needed
from gbspec.analysis.systems import System, ordered_modes
from gbspec.arrays import Array, ComplexArray
from gbspec.data import scales_of
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.frames import Shown, counted, of_rows

if TYPE_CHECKING:
    import polars as pl

    from gbspec.backends import Evaluator
    from gbspec.data import Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import DataRecord


@dataclass(frozen=True)
class InitialState:
    """The initial states [n] of one trajectory, at `time`, and the learned Jacobian's eigenvalues [n], slowest first.

    `learned_off` and `bred_off` [n] are the components of their differences from the true initial state in each mode
    (without a truth, of the learned from the bred one), as norms in units of the states' ranges; both modes of a
    complex pair have the norm of their common component.
    """

    trajectory: str
    time: float
    learned: Array
    bred: Array
    true: Array | None
    eigenvalues: ComplexArray
    learned_off: Array
    bred_off: Array | None

    def to_json(self, states: Sequence[str]) -> dict[str, object]:
        """Keys trajectory, time, learned, bred, true, eigenvalues, learned_off, bred_off."""

        def named(values: Array | None) -> dict[str, float] | None:
            return None if values is None else dict(zip(states, map(float, values), strict=True))

        return {
            "trajectory": self.trajectory,
            "time": self.time,
            "learned": named(self.learned),
            "bred": named(self.bred),
            "true": named(self.true),
            "eigenvalues": [[float(value.real), float(value.imag)] for value in self.eigenvalues],
            "learned_off": self.learned_off.tolist(),
            "bred_off": None if self.bred_off is None else self.bred_off.tolist(),
        }


@dataclass(frozen=True, repr=False)
class InitialStates(Shown):
    """The initial states of several trajectories, in the `states` of a model."""

    states: tuple[str, ...]
    items: tuple[InitialState, ...]

    def to_frame(self) -> pl.DataFrame:
        """One row for each trajectory and state: `trajectory`, `time`, `state`, `learned`, `bred`, `true`."""
        return of_rows(
            {
                "trajectory": item.trajectory,
                "time": item.time,
                "state": name,
                "learned": float(item.learned[i]),
                "bred": float(item.bred[i]),
                "true": None if item.true is None else float(item.true[i]),
            }
            for item in self.items
            for i, name in enumerate(self.states)
        )

    @property
    def reference(self) -> str:
        """The reference of the differences, in words."""
        return "the bred initial state" if self.items[0].true is None else "the true initial state"

    @property
    def rates(self) -> Array:
        """The median real part [n] of each mode's eigenvalue, slowest first."""
        return np.asarray(np.median([item.eigenvalues.real for item in self.items], axis=0))

    def to_json(self) -> dict[str, object]:
        """The document of `eigen --initial-states --json`."""
        return {
            "states": list(self.states),
            "reference": self.reference,
            "initial_states": [item.to_json(self.states) for item in self.items],
        }

    def __str__(self) -> str:
        lines = []
        for item in self.items:
            lines.append(f"{item.trajectory}, at {item.time:.6g}")
            for word, values in (("learned", item.learned), ("bred", item.bred), ("true", item.true)):
                if values is not None:
                    places = (f"{name} = {value:.6g}" for name, value in zip(self.states, values, strict=True))
                    lines.append(f"  {word:<8} " + ", ".join(places))
        count = counted(len(self.items), "trajectory")
        lines.append(f"distance from {self.reference}, in units of the states' ranges (median of {count})")
        for rank, rate in enumerate(self.rates):
            shown = [f"learned {_median([item.learned_off[rank] for item in self.items]):.2e}"]
            bred = [item.bred_off[rank] for item in self.items if item.bred_off is not None]
            shown += [f"bred {_median(bred):.2e}"] if bred else []
            lines.append(f"  mode {rank + 1} (real part {rate:.4g}): " + ", ".join(shown))
        return "\n".join(lines)


def _median(values: Sequence[float]) -> float:
    return float(np.median(values))


def initial_states(
    evaluator: Evaluator,
    model: Model,
    data: Trajectories,
    trained_on: DataRecord | None,
    system: System,
    truth: Evaluator | None = None,
    indices: Sequence[int] | None = None,
) -> InitialStates:
    """Compares the initial states of trajectories (default: all, else `indices`) of a table that a run was trained on.

    `evaluator` and `truth` are those of a member and of the model's truth, `system` is that of the member, `trained_on`
    the entry of `fit.json` about the data. Raises UserError (GB876) if there is nothing to compare.
    """
    if model.delays:
        message = "initial states of a model with delays are not compared: its solutions depend on the past as well"
        raise UserError([Diagnostic("GB876", message, None, help="compare solutions: `gbspec plot fit RUN`")])
    chosen = range(len(data)) if indices is None else indices
    positions = learned_positions(evaluator.instance, data, trained_on)
    scales = scales_of(model, data)
    breeder = Estimator(evaluator, model, scales)
    judge = None if truth is None else Estimator(truth, model, scales)
    found = []
    for index in chosen:
        item, position = data.items[index], positions[index]
        if position is None:
            continue
        learned = learned_start(evaluator, position, item)
        if not needed(model, item) and not _moved(model, item, learned.state):
            continue
        bred, true = breeder.start(item), None if judge is None else judge.start(item)
        if bred.origin == "failed" or (true is not None and true.origin == "failed"):
            continue
        moved = system.with_values({
            **dict(zip(system.conditions, map(float, item.condition), strict=True)),
            **dict(zip(system.constants, map(float, learned.constants), strict=True)),
            **system.inputs_at(item.inputs, item.start),
        })  # fmt: skip
        reference = bred.state if true is None else true.state
        eigenvalues, split = _modes(moved.linearise(reference, item.start)[1], system.scale)
        found.append(
            InitialState(
                item.label,
                float(item.start),
                learned.state,
                bred.state,
                None if true is None else true.state,
                eigenvalues,
                split(learned.state - reference),
                None if true is None else split(bred.state - reference),
            )
        )
    if not found:
        _refuse(any(position is not None for position in positions))
    return InitialStates(system.states, tuple(found))


def _moved(model: Model, item: Trajectory, learned: Array) -> bool:
    """Whether a fit, as of whole solutions, has learned starts that the first row measures."""
    apart = learned != measured_start(model, item, learned)
    return any(apart[i] for i, state in enumerate(model.states) if state.initial.kind == "measured")


def _modes(jacobian: Array, scale: Array) -> tuple[ComplexArray, Callable[[Array], Array]]:
    """The eigenvalues [n], slowest first, and a function: the norm [n] of a difference's component in each mode."""
    ordered, right = ordered_modes(jacobian * scale / scale[:, None])

    def split(difference: Array) -> Array:
        parts = right * np.linalg.lstsq(right, (difference / scale).astype(complex), rcond=None)[0]
        # The two components of a complex pair add up to a real one.
        whole = np.where(ordered.imag != 0.0, 2.0 * parts.real, parts.real)
        return np.asarray(np.linalg.norm(whole, axis=0))

    return ordered, split


def _refuse(trained: bool) -> None:
    findings = Findings()
    if trained:
        message = "no initial states of these trajectories were learned: the model or the table gives them"
        help = "leave the first measurement out, or let a state be learned: `initial x learn`"
    else:
        message = "the run was not trained on any of these trajectories"
        help = "give the table of training data"
    findings.error("GB876", message, None, help=help)
    findings.raise_if_failed()
