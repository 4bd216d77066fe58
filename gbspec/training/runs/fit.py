"""Training as a whole: the run directory, the members, and the content of `fit.json`."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from gbspec.backends import INTERFACE, generate, load_module
from gbspec.data import Trajectories, content_digest, scales_of, to_arrays
from gbspec.diagnostics import ComputationError, Diagnostic, Findings, UserError
from gbspec.files import clear, finite, is_aside
from gbspec.ir import AUTO, METHODS, Model, informative_at_start
from gbspec.runs import (
    DAMAGED,
    DataRecord,
    FitRecord,
    MemberRecord,
    Run,
    ScalesRecord,
    check_weights,
    files,
    locked,
    member_numbers,
    read_record,
    sealed_record,
)
from gbspec.training.engines import choose, device_of
from gbspec.training.options import TrainOptions
from gbspec.training.progress import Progress, Silent
from gbspec.training.recipe import (
    build_context,
    check_disturbed,
    check_limits,
    check_starts,
    chosen_solver,
    plan,
    said_of_step,
    solver_of,
)
from gbspec.training.runs import verdict
from gbspec.training.runs.absent import without_data
from gbspec.training.runs.backend import agreed, faster_backend
from gbspec.training.runs.constants import (
    EXACT,
    at_bounds,
    constant_record,
    correlations_of,
    moving_together,
    own_records,
    said_of_constants,
)
from gbspec.training.runs.jobs import Job
from gbspec.training.runs.parallel import fit_jobs
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.warned import warnings_of
from gbspec.training.starts import earlier
from gbspec.version import __version__

OWN = frozenset(
    {files.FIT, files.MODEL, files.MODULE, files.HISTORY, files.DATA, files.MEMBERS, files.LOCK}
    | {"report.html", "__pycache__"}
)
"""What a run directory contains; Python leaves `__pycache__` where somebody imported the module."""


def train(
    model: Model,
    trajectories: Trajectories,
    options: TrainOptions,
    directory: Path | str,
    progress: Progress | None = None,
) -> Run:
    """Fits all members and writes the run directory.

    Raises UserError (GB850 options, GB855 the directory in use, GB856 nothing to learn from, GB860 no cluster, GB861 no
    GPU, GB863 no native kernel, GB864 another process writes to the directory), ComputationError if no member could be
    fitted (earlier results stay in the directory; if only some members fail, messages say so), and KeyboardInterrupt
    when the process is asked to end (SIGINT, SIGTERM, SIGHUP), after writing a run that can be used and resumed.
    """
    shown = progress or Silent()
    fitting = Fitting(model, trajectories, options, Path(directory), shown)
    with writing(fitting.path, options.resume):
        fitting.begin()
        try:
            fit_jobs(fitting.jobs(), options, shown, fitting.take)
        except UserError:
            fitting.withdraw()
            raise
        finally:
            fitting.write()
    return fitting.run()


@contextmanager
def writing(path: Path, resume: bool = False) -> Iterator[None]:
    """Holds a run directory against other processes, and removes what a killed one has left behind in it.

    Raises UserError: GB855 if the directory holds other things than a run, or does not exist although a run is to be
    resumed, GB864 if another process writes to it.
    """
    if resume and not path.exists():
        raise _nothing_to_resume(path)
    _check_place(path)
    with locked(path):
        clear(path)
        yield


class Fitting:
    """A run directory during training: its jobs and their results.

    Raises UserError if the options, the data or the directory are unsuitable.
    """

    def __init__(
        self, model: Model, trajectories: Trajectories, options: TrainOptions, path: Path, progress: Progress
    ) -> None:
        findings = Findings()
        options.check(findings)
        check_disturbed(model, options)
        self._remarks = [*check_limits(model, trajectories), *without_data(model, trajectories)]
        _check_data(model, trajectories, findings)
        findings.raise_if_failed()
        check_starts(model, trajectories, options)
        module = load_module(model, METHODS[solver_of(options)])
        if options.scheduler is None:
            device_of(options.device)
            if options.backend == "native":
                choose(model, module, options, 0)
        if options.start is not None:
            earlier(options.start, model, module)
        if options.named_stages:
            anywhere = replace(options, backend="torch", device="cpu")  # a worker's resources are not checked here
            context = build_context(model, module, trajectories, anywhere, options.seed)
            plan(context, context.parameters({}))
        self.model, self.trajectories, self.options, self.path = model, trajectories, options, path
        self.progress, self._module = progress, module
        self.record = _record(model, trajectories, options, path)
        self.results: dict[int, MemberResult] = {}
        self.failures: dict[int, ComputationError] = {}
        self._begun = True  # until `begin` has looked

    def begin(self) -> None:
        """Creates the directory, or finds the run to resume. Raises UserError if this is impossible."""
        for remark in said_of_step(self.model, self.options):
            self.progress.message(remark)
        self._begun = (self.path / files.FIT).is_file()
        if self._begun:
            before = _prepare(self.path, self.model, self.record, self.options)
            taken = replace(self.record, backend=before.backend, solver=before.solver)
            self.record = replace(taken, solver_reason=before.solver_reason)
            self._module = load_module(self.model, METHODS[before.solver])
        else:
            self._choose_solver()
            options = replace(self.options, solver=self.record.solver)
            found = faster_backend(self.model, self._module, self.trajectories, options, self.progress)
            self.record = _prepare(self.path, self.model, replace(self.record, backend=found), self.options)
        if not _in_table(self.trajectories):
            files.write_tensors(self.path / files.DATA, *to_arrays(self.trajectories))

    def withdraw(self) -> None:
        """Leaves no run where training was refused before anything was learned: the corrected call begins it."""
        if self._begun or self.results or self.failures:
            return
        for name in (files.FIT, files.MODEL, files.MODULE, files.DATA):
            (self.path / name).unlink(missing_ok=True)

    def _choose_solver(self) -> None:
        """Chooses the solver where that is left to the training."""
        if self.options.solver != AUTO:
            return
        name, reason = chosen_solver(self.model, self._module, self.trajectories, self.options)
        self.record = replace(self.record, solver=name, solver_reason=reason)
        self._module = load_module(self.model, METHODS[name])
        if name != solver_of(self.options):
            self.progress.message(f"the solver is `{name}`: {reason}")

    def jobs(self, first: int = 0) -> list[Job]:
        """One job per member, numbered from `first`."""
        chosen = replace(self.options, solver=self.record.solver)
        options = agreed(self.record.backend, self.model, self._module, chosen)
        return [
            Job(self.model, self.trajectories, options, member, self.path, first + member)
            for member in range(self.options.members)
        ]

    def take(self, job: Job, outcome: MemberResult | ComputationError) -> None:
        """Records the result of a member."""
        if isinstance(outcome, ComputationError):
            self.failures[job.member] = outcome
            self.progress.message(f"member {job.member} failed: {outcome.what}")
        else:
            self.results[job.member] = outcome

    def write(self) -> None:
        """Writes `fit.json` and `history.csv`, if a member could be fitted."""
        if self.results:
            self.record = completed(self.record, self.model, self.results, self.options)
            by_one = verdict.inseparable_by_one(self.model) if len(self.trajectories) == 1 else []
            known = (*verdict.inseparable(self.model), *by_one, *self._remarks)
            self.record = replace(self.record, warnings=(*known, *self.record.warnings))
            ended = len(self.results) + len(self.failures) == self.options.members
            finished = ended and all(result.finished for result in self.results.values())
            self.record = _write_results(self.path, self.model, replace(self.record, finished=finished), self.results)

    def run(self) -> Run:
        """The run; raises the first member's ComputationError if none could be fitted."""
        if self.failures and not self.results:
            raise self.failures[min(self.failures)]
        return Run(self.path, self.model, self.record, tuple(sorted(self.results)))


def _check_data(model: Model, trajectories: Trajectories, findings: Findings) -> None:
    if trajectories.measurements == 0:
        findings.error("GB856", "the data contain no measured value, so that nothing can be learned", None)
        return
    informative = np.array(informative_at_start(model))
    if any(
        np.any(item.times > item.start) or np.isfinite(item.values[:, informative]).any() for item in trajectories.items
    ):
        return
    message = (
        "no trajectory has a measurement after its start, and what is measured there contains neither a rate nor "
        "anything else that is learned, so that the dynamics cannot be learned"
    )
    start = model.time.start
    fixed = f"; the model lets trajectories start at {model.time.name} = {start:g}" if start is not None else ""
    help = "add later rows, or state when trajectories start, before their first rows: `time t from 0`"
    findings.error("GB856", message, None, help="add later rows" + fixed if fixed else help)


def _record(model: Model, trajectories: Trajectories, options: TrainOptions, path: Path) -> FitRecord:
    """The record before training."""
    packages = ("torch", "numpy", "scipy", "sympy", "casadi")
    return FitRecord(
        gbspec=__version__,
        model=model.name,
        data=_data_record(trajectories, model, path),
        options=options.to_json(),
        versions={"python": platform.python_version(), **{name: version(name) for name in packages}},
        constants={},
        noise={},
        members=(),
        warnings=(),
        solver=solver_of(options),
        interface=INTERFACE,
        scales=ScalesRecord.of(scales_of(model, trajectories)),
        finished=False,
    )


def _data_record(trajectories: Trajectories, model: Model, run: Path) -> DataRecord:
    rows = trajectories.rows or sum(len(item.times) for item in trajectories.items)
    counts = len(trajectories), rows, trajectories.measurements
    values = np.array([item.condition for item in trajectories.items], dtype=np.float64)
    each = {one.name: (float(values[:, i].min()), float(values[:, i].max())) for i, one in enumerate(model.conditions)}
    conditions = each or None
    if not _in_table(trajectories):
        digest = trajectories.sha256 or content_digest(trajectories)
        return DataRecord("", digest, *counts, conditions=conditions)
    absolute = Path(trajectories.path).resolve()
    try:
        relative: str | None = os.path.relpath(absolute, run.resolve())
    except ValueError:  # on another drive
        relative = None
    form = trajectories.meta.get("format")
    content = content_digest(trajectories)
    return DataRecord(
        trajectories.path, trajectories.sha256, *counts, str(absolute), relative, form, conditions, content
    )


def _in_table(trajectories: Trajectories) -> bool:
    return bool(trajectories.path and trajectories.sha256)


# -------------------------------------------------------------------------------------------------- the directory
def _prepare(path: Path, model: Model, record: FitRecord, options: TrainOptions) -> FitRecord:
    """Creates the directory, or finds the run to resume in it; one whose training was killed at once is begun again.

    Returns the record with which the run was begun.
    """
    _check_place(path)
    begun, before = (path / files.FIT).is_file(), record
    if options.resume and begun:
        before = _check_resumable(path, model, record)
        # Files of members are newer than `fit.json` from now on.
        replace(before, options=record.options, finished=False).write(path)
    elif options.resume and not path.is_dir():
        raise _nothing_to_resume(path)
    elif begun:
        message = f"`{path}` already contains a run"
        help_text = "name another directory with `-o`, delete this one, or continue it with `--resume`"
        raise UserError([Diagnostic("GB855", message, None, help=help_text)])
    elif member_numbers(path):
        message = f"`{path / files.FIT}` is missing, without which the members there cannot be continued"
        raise UserError([Diagnostic("GB852", message, None, help=DAMAGED)])
    path.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path / files.MODEL, model.text.encode("utf-8"))
    files.write_bytes(path / files.MODULE, generate(model, METHODS[before.solver]).encode("utf-8"))
    if not begun:
        record.write(path)
    return before


def _nothing_to_resume(path: Path) -> UserError:
    advice = "check the path, or train without `--resume`"
    return UserError([Diagnostic("GB855", f"there is no run to resume in `{path}`", None, help=advice)])


def unbegun(path: Path) -> bool:
    """Whether a directory is empty, or holds only what a training that was killed at once has left."""
    before = {files.MODEL, files.MODULE}
    left = [p for p in path.iterdir() if p.name not in before and p.name != files.LOCK and not is_aside(p.name)]
    return all(p.is_dir() and files.is_blank(p) for p in left)


def _check_place(path: Path) -> None:
    """Raises UserError (GB855) if the path is a file, or a directory with other files than those of a run."""
    if path.exists() and not path.is_dir():
        raise UserError([Diagnostic("GB855", f"`{path}` is a file; the run needs a directory", None)])
    existing = sorted(p.name for p in path.iterdir()) if path.is_dir() else []
    foreign = [name for name in existing if name not in OWN and not is_aside(name)]
    if foreign:
        message = f"`{path}` contains files that do not belong to a run, such as `{foreign[0]}`"
        raise UserError([Diagnostic("GB855", message, None, help="name another directory with `-o`")])


def _check_resumable(path: Path, model: Model, record: FitRecord) -> FitRecord:
    """The record of the run; raises UserError if model, data or options are not those with which it was begun."""
    findings = Findings()
    before = read_record(path, findings)
    if before is None:
        raise UserError(findings)
    check_weights(path, before, model)
    try:
        text = (path / files.MODEL).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError([Diagnostic("GB852", f"the run `{path}` cannot be resumed: {error}", None)]) from None
    if text != model.text:
        findings.error("GB855", f"the run `{path}` was started with another model", None, help=_OTHER)
    if before.data.sha256 != record.data.sha256:
        findings.error("GB855", f"the run `{path}` was started with other data", None, help=_OTHER)
    may_change = {"members", "workers", "threads", "device", "backend"}
    began = TrainOptions.recorded(before.options, path).to_json()
    if _same_solver(record.options.get("solver"), began["solver"], before.solver):
        may_change.add("solver")
    for name, value in record.options.items():
        old = began[name]
        if name not in may_change and old != value:
            flag = name.replace("_", "-")
            findings.error(
                "GB855", f"the run `{path}` was started with `--{flag} {old}`, not {value}", None, help=_OTHER
            )
    findings.raise_if_failed()
    return before


def _same_solver(now: object, began: object, used: str) -> bool:
    """Whether a run can go on with its solver: it is left to the training now, or it is the one that was chosen."""
    return bool(now == AUTO or (began == AUTO and now == used))


_OTHER = "continue it with the original settings, or name another directory with `-o`"


# -------------------------------------------------------------------------------------------------- results
def completed(record: FitRecord, model: Model, results: dict[int, MemberResult], options: TrainOptions) -> FitRecord:
    """The record completed by the results of the members, of which there is at least one."""
    ordered = [results[k] for k in sorted(results)]
    ended = [
        (member, k, bound)
        for member, r in sorted(results.items())
        if r.loss > EXACT  # nothing holds back a fit without residuals
        for k, bound in at_bounds(model, r.constants, r.sd)
    ]
    shared = {k.name for k in model.learnables if not k.per_trajectory}
    for member, name, _ in ended:  # the curvature is not valid for a constant at its bound
        results[member].sd[name] = float("nan")
        if model.diffusions and name in shared:
            results[member].bounded |= {name}
    own = own_records(model, ordered)
    best = min(
        ordered, key=lambda r: (r.objective is None, r.objective.value if r.objective and r.objective.value else 0.0)
    )
    weighed = [r.scales for r in ordered if r.scales is not None]
    correlations = correlations_of([k.name for k in model.learnables if k.name in shared], ordered)
    constants = {k.name: constant_record(k, ordered, own.get(k.name)) for k in model.learnables}
    said = said_of_constants(model, constants, ended, results)
    misjudged = {name for r in ordered for name in r.misjudged}  # their correlations are those of the same curvature
    certain = {name for name, each in constants.items() if each.certain}
    at_bound = {name for _, name, _ in ended}  # no curvature holds there
    inside = [name for name in correlations if name not in at_bound]
    table = {name: {other: correlations[name][other] for other in inside} for name in inside}
    together = moving_together(table, certain | misjudged)
    return replace(
        record,
        constants=constants,
        noise={c.name: finite(float(np.mean([r.noise[c.name] for r in ordered]))) for c in model.channels},
        members=tuple(_member(k, results[k]) for k in sorted(results)),
        warnings=(*warnings_of(results, options, model), *together, *said),
        correlations=correlations,
        objective=best.objective,
        population=best.population,
        scales=ScalesRecord.mean(weighed) if len(weighed) == len(ordered) else record.scales,
    )


def _write_results(path: Path, model: Model, record: FitRecord, results: dict[int, MemberResult]) -> FitRecord:
    """Writes `history.csv` and then `fit.json`, with the digests of all files; returns its content."""
    rows = [
        [member, stage, iteration, seconds, loss, *constants]
        for member in sorted(results)
        for stage, iteration, seconds, loss, constants in results[member].history
    ]
    files.write_history(path / files.HISTORY, [k.name for k in model.learnables], rows)
    whole = sealed_record(path, record)
    whole.write(path)
    return whole


def _member(number: int, result: MemberResult) -> MemberRecord:
    stages = tuple(replace(stage, loss=finite(stage.loss)) for stage in result.stages)
    rmse = {name: finite(value) for name, value in result.rmse.items()}
    interval = finite(result.interval_loss)
    known = (result.channels, result.likelihood, result.freedom)
    return MemberRecord(result.seed, finite(result.loss), rmse, result.seconds, stages, number, None, interval, *known)
