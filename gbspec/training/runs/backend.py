"""`--backend auto` with few sub-steps: whether the kernel is worth its compilation, by measuring both for a moment."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule
from gbspec.data import Trajectories
from gbspec.ir import Model
from gbspec.runs import BackendRecord
from gbspec.training.engines import Choice, choose, device_of, few, linearise, predicted
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Parameters
from gbspec.training.progress import Progress
from gbspec.training.recipe import Context, Planned, build_context, initial, plan
from gbspec.training.stages import StageName

COMPILATION = 3.0
"""Seconds that the compilation of a kernel takes; it is not worth it for a fit that the torch graph does in less."""
LONGEST = 60.0
"""Where whole solutions alone would take the torch graph so many seconds, its Jacobian, which takes far longer, is not
measured, and the kernel is used."""
PREPARATION = 1.0
"""Seconds that the first run of an engine spends at most on preparations."""

INTERVALS = frozenset(
    {StageName.ADAM, StageName.IMPUTED, StageName.TEACHER, StageName.HALF_STEP, StageName.BLEND, StageName.AS_ASKED}
    | {StageName.LEAST_SQUARES, StageName.LBFGS, StageName.LEVENBERG_MARQUARDT}
)
"""Stages of which half the largest number of iterations is expected, each with a Jacobian at the forcing asked for."""
WHOLE = frozenset({StageName.AUTOREGRESSIVE, StageName.WHOLE})
"""Stages of which a quarter of the iterations is expected, each with four whole solutions: as many as iterations."""

clock: Callable[[], float] = time.perf_counter
"""The clock, which tests replace."""


def faster_backend(
    model: Model, module: type[GeneratedModule], trajectories: Trajectories, options: TrainOptions, progress: Progress
) -> BackendRecord | None:
    """The faster of the kernel and the torch graph for the first member; None where the kernel is not considered.

    It is decided once for all members, so that their fits do not depend on how they are divided among processes, and
    in the process that begins the run. Where a cluster fits the members, nothing here tells how fast its machines are.
    """
    if options.backend != "auto" or options.scheduler is not None or device_of(options.device) != "cpu":
        return None
    if not few(model, options, sum(len(item.times) - 1 for item in trajectories.items)):
        return None  # there is a sub-step between any two rows, so that large data are not packed only to count them
    context = build_context(model, module, trajectories, replace(options, backend="torch"), options.seed)
    if not few(model, options, context.packed().substeps):
        return None
    # Networks have the scales of their arguments, since without them solutions may take far more steps.
    parameters, theta = initial(context)
    stages = plan(context, parameters)
    by_torch = expected_seconds(context, context.choice, parameters, theta, stages, WHOLE)
    long = by_torch > LONGEST
    if not long:
        by_torch += expected_seconds(context, context.choice, parameters, theta, stages, INTERVALS)
    if by_torch <= COMPILATION:
        return None
    other = choose(model, module, options, context.packed().substeps, worthwhile=True)
    if other.kernel is None:
        progress.message(other.remark)
        return None
    by_kernel = sum(expected_seconds(context, other, parameters, theta, stages, kind) for kind in (INTERVALS, WHOLE))
    found = BackendRecord("native" if long or by_kernel < by_torch else "torch", by_torch, by_kernel)
    name = "compiled kernel" if found.used == "native" else "torch graph"
    progress.message(
        f"the {name} is used: measured for a moment, a fit would take {'more than' if long else 'about'} "
        f"{by_torch:.2g} s by the torch graph and {by_kernel:.2g} s by the kernel"
    )
    return found


def expected_seconds(
    context: Context,
    choice: Choice,
    parameters: Parameters,
    theta: Array,
    stages: Iterable[Planned],
    kind: frozenset[StageName],
) -> float:
    """The seconds that the iterations of the stages of a `kind` take in a usual fit: those of `INTERVALS` from one
    Jacobian, those of `WHOLE` from one whole solution.

    Whole solutions are only compared with the data here: their Jacobian costs as much as that of the intervals.
    """
    count = sum(stage.total for stage in stages if stage.name in kind)
    if not count:
        return 0.0
    if kind is WHOLE:
        whole = choice.engine(context.problem(0.0), parameters)
        return count * _shortest(lambda: predicted(whole, theta))
    intervals = choice.engine(context.problem(context.options.blend), parameters)
    return count / 2 * _shortest(lambda: linearise(intervals, theta))


def _shortest(work: Callable[[], object]) -> float:
    """The seconds of the second of two runs, or of the first if that was shorter: the first one also prepares.

    A run that takes longer than preparations do is not repeated.
    """
    times: list[float] = []
    while len(times) < 2 and min(times, default=0.0) < PREPARATION:
        began = clock()
        work()
        times.append(clock() - began)
    return min(times)


def agreed(
    found: BackendRecord | None, model: Model, module: type[GeneratedModule], options: TrainOptions
) -> TrainOptions:
    """The options with the backend that was found when the run was begun; the torch graph where there is no kernel."""
    if found is None or options.backend != "auto" or options.scheduler is not None:
        return options
    if found.used == "native" and choose(model, module, options, 0, worthwhile=True).kernel is None:
        return replace(options, backend="torch")
    return replace(options, backend=found.used)
