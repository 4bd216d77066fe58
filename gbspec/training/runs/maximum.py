"""Whether a member has come to a maximum of the likelihood, and the way back to one from a stage that failed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Estimated
from gbspec.diagnostics import ComputationError
from gbspec.training.optimise import InnovationsFit, OtherMaxima, Stage
from gbspec.training.runs.ended_early import LIKELIHOODS, NO_FIT, said_of_unfinished
from gbspec.training.runs.position import Position
from gbspec.training.stages import StageName


def note_end(position: Position, name: str, unfinished: ComputationError | None) -> None:
    """Notes that a stage took its last step: at a maximum if it is one of a likelihood, unless it is `unfinished`. What
    was said of earlier stages that did not come to one is no longer true at a maximum. A search for times of jumps,
    whose fits take few steps, leaves the likelihood at its maximum only if it was there."""
    position.held &= not np.array_equal(position.best, position.theta)
    if unfinished is not None:
        position.maximum = False
        position.notes.append(said_of_unfinished(name, unfinished))
    elif name in LIKELIHOODS - {StageName.JUMPS}:
        position.maximum = True
        position.notes = [note for note in position.notes if NO_FIT not in note]


def noise_before(stage: Stage, position: Position) -> Estimated | None:
    """The noise by which channels were weighed at the maximum at which the present stage began."""
    if isinstance(stage, OtherMaxima) and isinstance(stage.fit, InnovationsFit) and position.state:
        return stage.fit.estimated(stage.beginning(position.state))
    return position.estimated


def return_to_maximum(position: Position, score: Callable[[Array, list[str]], float] | None) -> None:
    """Goes back from the present stage, which failed, to the maximum at which it began, as if it had not run. `score`
    is that of a vector after the stages of these names by held-out data; None where these choose nothing."""
    del position.history[len(position.history) - position.iteration :]
    position.stages.pop()
    begun = [stage.name for stage in position.stages]
    position.theta, position.ridge = position.entry, position.entry_ridge
    position.loss = float("nan" if position.stages[-1].loss is None else position.stages[-1].loss)
    if position.best_stages > len(position.stages):  # it is of the stage that is left out
        position.best, position.best_stages, position.held = position.entry, len(position.stages), False
        position.best_score = position.loss if score is None else score(position.entry, begun)
