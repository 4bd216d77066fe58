"""The position of a member in its training, and how it is written to a checkpoint and read from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Estimated
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.runs import JsonError, StageRecord, decode, encode, files
from gbspec.training.optimise import Certainty, State
from gbspec.training.runs.ended_early import LIKELIHOODS
from gbspec.training.runs.remarks import Exact, Remarks
from gbspec.training.starts import CurveKind

EDITION = 4
"""The edition of the stages' states. A stage in a checkpoint of an earlier one begins again at the vector it had."""


@dataclass
class Position:
    """The position of a member in its training: stage, number of completed steps, state, and history.

    `entry` is the vector at the beginning of the present stage, from which the stage is rebuilt on resume; `marks`
    holds the vectors at the ends of the previous stages, `notes` the remarks for the user; `best` and `best_score`
    belong to the vector that best predicts held-out data (without held-out data: the last one), `best_stages` is the
    number of stages that had begun then, which determine its step. `estimated` is the noise by which channels are
    weighed, if they are; `ridge` and `damping` are those of the last stage that had any, `entry_ridge` that at `entry`.
    `maximum`: whether a stage has ended at a maximum of the likelihood; `held`: whether `best` is no such end, since
    held-out data chose it on the way. `common`: whether all members hold out the same trajectories.
    """

    stage: int = 0
    iteration: int = 0
    state: State = field(default_factory=dict)
    entry: Array = field(default_factory=lambda: np.zeros(0))
    theta: Array = field(default_factory=lambda: np.zeros(0))
    best: Array = field(default_factory=lambda: np.zeros(0))
    best_score: float = float("inf")
    best_stages: int = 0
    marks: dict[str, Array] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    certainty: Certainty = field(default_factory=Certainty)
    seconds: float = 0.0
    loss: float = float("inf")
    history: list[tuple[str, int, float, float, tuple[float, ...]]] = field(default_factory=list)
    stages: list[StageRecord] = field(default_factory=list)
    finished: bool = False
    estimated: Estimated | None = None
    ridge: float = 0.0
    damping: float = 0.0
    maximum: bool = False
    held: bool = False
    entry_ridge: float = 0.0
    common: bool = True

    @property
    def fitted_stages(self) -> list[StageRecord]:
        """The stages up to the one that found the vector that is kept."""
        return self.stages[: self.best_stages or None]


def checkpoint(directory: Path) -> tuple[dict[str, Array], Remarks] | None:
    """The last checkpoint, if there is one. Raises `UserError` (GB852) if it is damaged."""
    path = directory / files.CHECKPOINT
    if not path.is_file():
        return None
    try:
        arrays, remarks = files.read_tensors(path)
        found = decode(Remarks, remarks)
        restored(arrays, found)
        wrong = [name for name, value in arrays.items() if name.startswith("fixed.") and not np.isfinite(value).all()]
        if wrong:
            raise ValueError(f"`{path}` is damaged: `{wrong[0]}` has entries that are not finite")
        return arrays, found
    except (KeyError, OverflowError) as error:
        raise _damaged(directory, f"`{path}` is damaged: it has no {error}") from None
    except ValueError as error:
        damaged = f"`{path}` is damaged: {error}" if isinstance(error, JsonError) else str(error)
        raise _damaged(directory, damaged) from None


def _damaged(directory: Path, message: str) -> UserError:
    return UserError([Diagnostic("GB852", message, None, help=f"delete `{directory}` to fit the member again")])


def restored(arrays: dict[str, Array], remarks: Remarks) -> Position:
    """The position stored in a checkpoint."""
    state = {name.partition("state.")[2]: v for name, v in arrays.items() if name.startswith("state.")}
    marks = {name.partition("mark.")[2]: v for name, v in arrays.items() if name.startswith("mark.")}
    ridge = float(arrays.get("ridge", np.array(0.0)))
    known = LIKELIHOODS & set(marks)
    chosen = not any(np.array_equal(arrays["best"], marks[name]) for name in known)
    return Position(
        stage=remarks.stage,
        iteration=remarks.iteration,
        state=state if float(arrays.get("edition", np.array(1.0))) == EDITION else {},
        entry=arrays["entry"],
        certainty=Certainty(
            arrays["deviations"],
            arrays["correlations"],
            float.fromhex(remarks.exact.freedom),
            arrays.get("own", np.zeros((0, 0))),
        ),
        theta=arrays["theta"],
        best=arrays["best"],
        best_stages=remarks.best_stages,
        best_score=float.fromhex(remarks.exact.best_score),
        seconds=remarks.seconds,
        loss=float.fromhex(remarks.exact.loss),
        history=[
            (name, i, seconds, float.fromhex(loss), tuple(float.fromhex(x) for x in constants))
            for name, i, seconds, loss, constants in remarks.history
        ],
        stages=list(remarks.stages),
        notes=list(remarks.notes),
        marks=marks,
        finished=remarks.finished,
        ridge=ridge,
        damping=float(arrays.get("damping", np.array(0.0))),
        maximum=bool(known) if remarks.maximum is None else remarks.maximum,
        held=chosen if remarks.held is None else remarks.held,
        common=remarks.common,
        entry_ridge=ridge if remarks.entry_ridge is None else float.fromhex(remarks.entry_ridge),
        estimated=Estimated(arrays["noise"], arrays["share"]) if "noise" in arrays else None,
    )


def write_position(directory: Path, position: Position, fixed: Mapping[str, Array], kind: CurveKind) -> None:
    """Writes the last and the best checkpoint of a member; `fixed` are the arrays of its layout that are not trained,
    `kind` is that of the curves of its warm start."""
    arrays = {f"state.{name}": np.asarray(value, dtype=np.float64) for name, value in position.state.items()}
    arrays |= {"theta": position.theta, "best": position.best, "entry": position.entry}
    certainty = position.certainty
    arrays |= {"deviations": certainty.deviations, "correlations": certainty.correlations, "own": certainty.own}
    arrays |= {f"mark.{name}": value for name, value in position.marks.items()}
    arrays |= {f"fixed.{name}": value for name, value in fixed.items()}
    arrays |= {
        "edition": np.array(float(EDITION)),
        "ridge": np.array(position.ridge),
        "damping": np.array(position.damping),
    }
    if position.estimated is not None:
        arrays |= {"noise": position.estimated.noise, "share": position.estimated.share}
    remarks = Remarks(
        stage=position.stage,
        iteration=position.iteration,
        seconds=position.seconds,
        finished=position.finished,
        smooth=kind == "smooth",
        pieces=kind == "pieces",
        maximum=position.maximum,
        held=position.held,
        common=position.common,
        entry_ridge=position.entry_ridge.hex(),
        stages=tuple(position.stages),
        notes=tuple(position.notes),
        exact=Exact(position.loss.hex(), position.best_score.hex(), position.certainty.freedom.hex()),
        history=tuple(
            (name, i, seconds, loss.hex(), tuple(x.hex() for x in constants))
            for name, i, seconds, loss, constants in position.history
        ),
        best_stages=position.best_stages,
    )
    files.write_tensors(directory / files.CHECKPOINT, arrays, encode(remarks))
    files.write_tensors(directory / files.CHECKPOINT_BEST, {"theta": position.best}, {"score": position.best_score})
