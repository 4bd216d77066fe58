"""What a member begins with: prepared from the data, or as its checkpoint has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.data import Trajectories
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Model
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Parameters
from gbspec.training.recipe import Context, at_stable_step, build_context, prepared
from gbspec.training.runs.position import Position, checkpoint, restored
from gbspec.training.runs.remarks import Remarks
from gbspec.training.stages import StageName


def beginning(
    model: Model,
    module: type[GeneratedModule],
    trajectories: Trajectories,
    options: TrainOptions,
    seed: int,
    kept: tuple[dict[str, Array], Remarks] | None,
    tell: Callable[[str], None],
) -> tuple[Context, Parameters, Position]:
    """The context, the layout and the position of a member; `kept` is its checkpoint, None if it begins."""
    if kept is not None:
        arrays, remarks = kept
        splitting = options if remarks.common else replace(options, seed=seed)
        context = build_context(model, module, trajectories, splitting, seed, remarks.curves)
        fixed = {name.partition("fixed.")[2]: v for name, v in arrays.items() if name.startswith("fixed.")}
        position, parameters = restored(arrays, remarks), context.parameters(fixed)
        first = position.marks.get(StageName.WARM_START, position.theta)
        return at_stable_step(context, parameters, first), parameters, position
    tell("curves through the data, first values of functions and constants")
    ready = prepared(model, module, trajectories, options, seed)
    if ready.fraction < 1:
        step, usual = ready.context.max_step, ready.context.max_step / ready.fraction
        tell(f"the step is {step:.3g} instead of {usual:.3g}, so that solutions are stable at the data")
    position = Position(theta=ready.theta, best=ready.theta, loss=ready.loss, estimated=ready.context.estimated)
    return ready.context, ready.parameters, position


def as_left(context: Context, position: Position) -> None:
    """Gives a context the noise and the steps with which a position was reached."""
    context.estimated = position.estimated
    context.cutting = context.cutting or StageName.CUT in [stage.name for stage in position.stages]


def restored_fit(
    model: Model,
    module: type[GeneratedModule],
    trajectories: Trajectories,
    options: TrainOptions,
    member: int,
    directory: Path,
) -> tuple[Context, Parameters, Position]:
    """The context, the layout and the position with which the fit of a member has ended, from its checkpoint.

    Raises UserError (GB852) if that is missing or damaged.
    """
    kept = checkpoint(directory)
    if kept is None:
        message = f"`{directory}` has no checkpoint, from which the fit could be gone on with"
        raise UserError([Diagnostic("GB852", message, None, help="train again")])
    found = beginning(model, module, trajectories, options, options.seed + member, kept, lambda text: None)
    context, parameters, position = found
    as_left(context, position)
    return context, context.parameters(parameters.fixed, released=True), position
