"""Opening a run directory: its model, its members' weights, the results of the fit, and predictions of all members."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule, load_module
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.frontend import load_model
from gbspec.ir import METHODS, Method, Model
from gbspec.runs import files, seals
from gbspec.runs.covariance import Certainties, Covariance, read_certainties
from gbspec.runs.locks import held_elsewhere
from gbspec.runs.member import LikelihoodRecord, MemberRecord, comparable_losses
from gbspec.runs.profiles import ProfileRecord, read_profile
from gbspec.runs.record import DAMAGED, ConstantRecord, FitRecord, check_weights, read_record


@dataclass(frozen=True)
class Run:
    """A run directory. `fit` is the content of `fit.json`; `numbers` are the members that have weights.

    `values` are constants set by the user; in every member they replace the learned values.
    """

    path: Path
    model: Model
    fit: FitRecord
    numbers: tuple[int, ...]
    values: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def module(self) -> type[GeneratedModule]:
        """The class of the generated module, with the Runge-Kutta method that the run was trained with."""
        return load_module(self.model, self.method)

    @property
    def method(self) -> Method:
        """The Runge-Kutta method of the training; older runs, which do not name it, used the classical one."""
        return METHODS[self.fit.solver]

    def stepped_by(self, method: Method) -> Run:
        """The same run with another Runge-Kutta method."""
        return replace(self, fit=replace(self.fit, solver=method.name))

    @cached_property
    def _loaded(self) -> dict[int, GeneratedModule]:
        return {}

    def member(self, number: int = 0) -> GeneratedModule:
        """The generated module with the weights of one member.

        Raises `UserError`: GB854 if there is no such member, GB853 if its weights are damaged or belong to another
        model.
        """
        if number not in self.numbers:
            there = ", ".join(map(str, self.numbers))
            message = f"the run `{self.path}` has no member {number}"
            raise UserError([Diagnostic("GB854", message, None, help=f"its members are {there}")])
        if number not in self._loaded:
            try:
                found = self.module.load(self.path, number)
                seals.opened(found)
                self._loaded[number] = self._set(found)
            except (ValueError, OSError, KeyError, TypeError, RecursionError) as error:
                message = f"the weights of member {number} of `{self.path}` cannot be read: {error}"
                raise UserError([Diagnostic("GB853", message, None, help=seals.RESTORE)]) from None
        return self._loaded[number]

    def _set(self, member: GeneratedModule) -> GeneratedModule:
        """The member with its constants set to `values`; a constant per trajectory is set in all trajectories."""
        if not self.values:
            return member
        learned = zip(member.constants, member.weights["constants"], strict=True)
        weights = {**member.weights, "constants": np.array([self.values.get(name, value) for name, value in learned])}
        for name in member.per_trajectory:
            if name in self.values and f"per_trajectory.{name}" in weights:
                weights[f"per_trajectory.{name}"] = np.full_like(weights[f"per_trajectory.{name}"], self.values[name])
        return type(member)(weights, member.info)

    def certainties(self, number: int = 0) -> Certainties:
        """The covariance of a member's parameters, and where its unknowns were trained; empty for older runs."""
        if number not in self._certainties:
            found = read_certainties(files.member_directory(self.path, number))
            self._certainties[number] = found if self._fits(found.covariance, number) else Certainties()
        return self._certainties[number]

    def _fits(self, known: Covariance | None, number: int) -> bool:
        """Whether a covariance is one of the member's weights and of learned constants, as it is unless damaged."""
        if known is None:
            return True
        weights, learned = self.member(number).weights, {k.name for k in self.model.learnables}
        sizes = [np.size(weights[name]) if name in weights else -1 for name in known.names]
        return min(sizes, default=0) >= 0 and sum(sizes) == known.vectors.shape[1] and set(known.constants) <= learned

    @cached_property
    def _certainties(self) -> dict[int, Certainties]:
        return {}

    def profiled(self, constant: str) -> ProfileRecord | None:
        """The result of a profile of a constant: of the best member, else of another; None if none was made."""
        numbers = (self.best, *(number for number in self.numbers if number != self.best))
        return next((one for number in numbers if (one := read_profile(self.path, number, constant))), None)

    def amended(self, fit: FitRecord) -> Run:
        """The same run with another `fit.json`, which is also written."""
        fit.write(self.path)
        return replace(self, fit=fit)

    @property
    def members(self) -> tuple[GeneratedModule, ...]:
        """The generated module with the weights of each member."""
        return tuple(self.member(number) for number in self.numbers)

    @property
    def best(self) -> int:
        """The number of the member with the smallest loss, with the same weights of the channels for all of them."""
        entries = zip(self.numbers, comparable_losses(self.fit.members), strict=False)
        losses = {number: loss for number, loss in entries if loss is not None}
        return min(losses, key=lambda n: losses[n]) if losses else self.numbers[0]

    @property
    def innovations(self) -> LikelihoodRecord | None:
        """The likelihood of innovations of the best member; None of a fit that has another objective."""
        return self.fit.members[self.numbers.index(self.best)].likelihood if self.fit.members else None

    def mean(self, predict: Callable[[GeneratedModule], Array]) -> Array:
        """The mean over members of the result of `predict` (module instance -> array)."""
        return np.asarray(np.mean([predict(member) for member in self.members], axis=0), dtype=np.float64)

    def standard_deviation(self, predict: Callable[[GeneratedModule], Array]) -> Array:
        """The standard deviation over members of the result of `predict` (zero for a single member)."""
        return np.asarray(np.std([predict(member) for member in self.members], axis=0), dtype=np.float64)

    def step(self, number: int) -> float | None:
        """The largest step of the solver in the last fit of a member."""
        value = self.member(number).info.get("max_step")
        return float(value) if isinstance(value, int | float) else None

    def filter_step(self, number: int) -> float | None:
        """The largest step of a member's filter between two rows, where disturbances are random."""
        value = self.member(number).info.get("filter_step")
        return float(value) if isinstance(value, int | float) else self.step(number)

    def tolerance(self, number: int) -> float | None:
        """The tolerance of the solver's steps in the last fit of a member; None if they were fixed."""
        value = self.member(number).info.get("tolerance")
        return float(value) if isinstance(value, int | float) else None

    def equal_step(self, number: int) -> float | None:
        """The same if steps were equal ones; None if they end where right-hand sides switch."""
        return None if self.member(number).info.get("switches") else self.step(number)

    def history(self) -> list[dict[str, str]]:
        """The rows of `history.csv`; empty if there is no such file. Raises `UserError` (GB852) if it is damaged."""
        return files.read_history(self.path / files.HISTORY)


def open_run(path: str | Path, warnings: Findings | None = None) -> Run:
    """Reads a run directory; that it is of an older version (GB857) or not finished (GB865) is added to `warnings`.

    Raises `UserError`: GB851 if it is not a run, GB852 if one of its files is missing or damaged, GB857 if it has
    another version of the generated module, GB853 if no member has weights or these were changed; also with the errors
    of its `model.gb`.
    """
    directory = Path(path)
    if not (directory / files.FIT).is_file() and not (directory / files.MODEL).is_file():
        message = f"`{directory}` is not a run directory"
        help_text = "a run is what `gbspec train MODEL DATA -o RUN` writes: it holds `model.gb` and `fit.json`"
        raise UserError([Diagnostic("GB851", message, None, help=help_text)])
    findings = Findings()
    fit = read_record(directory, findings)
    if not (directory / files.MODEL).is_file():
        findings.error("GB852", f"`{directory / files.MODEL}` is missing", None, help=DAMAGED)
    if fit is not None and fit.finished:
        seals.check(directory, fit, findings)
    if fit is None or findings.failed:
        raise UserError(findings)
    model = _model_of(directory)
    check_weights(directory, fit, model)
    run = Run(directory, model, fit, _numbers(directory, fit))
    if not run.numbers:
        message = f"no member of the run `{directory}` has weights"
        help_text = "its training stopped before the first iteration; train again (`--resume` continues)"
        raise UserError([Diagnostic("GB853", message, None, help=help_text)])
    if not fit.finished:
        trained_now = held_elsewhere(directory)
        run = _unfinished(run, trained_now)
        findings.warning("GB865", unfinished(run, trained_now), None, help=WAIT if trained_now else CONTINUE)
    if warnings is not None:
        warnings.extend(findings)
    return run


CONTINUE = "the command of the training with `--resume` continues it"
WAIT = "what it will end with is known when that process has ended; `--resume` is not needed"


def unfinished(run: Run, trained_now: bool) -> str:
    """What can be used of a run that is not finished, in a sentence."""
    listed = ", ".join(map(str, run.numbers))
    planned = run.fit.options.get("members")
    members = f"member{'s' if len(run.numbers) > 1 else ''} {listed} of {planned}"
    if trained_now:
        return f"`{run.path}` is being trained by another process: {members} can be used, as far as trained by now"
    return f"the training of `{run.path}` was interrupted: {members} can be used, in the state that they had reached"


def _model_of(directory: Path) -> Model:
    """The model of a run; that it cannot be read as text is a damaged file (GB852)."""
    path = directory / files.MODEL
    try:
        path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError([Diagnostic("GB852", f"`{path}` cannot be read: {error}", None, help=DAMAGED)]) from None
    return load_model(path, Findings())


def _numbers(directory: Path, fit: FitRecord) -> tuple[int, ...]:
    """The members that can be used: of a finished run those that `fit.json` lists, else all that have weights."""
    there = member_numbers(directory)
    listed = {entry.member for entry in fit.members}
    return there if not fit.finished or None in listed or not listed else tuple(n for n in there if n in listed)


def _unfinished(run: Run, trained_now: bool) -> Run:
    """The run with what is known of members whose files are newer than `fit.json`, from their weights files.

    Their constants have no intervals, which are known at the end only.
    """
    known = {entry.member: entry for entry in run.fit.members}
    summaries: dict[int, seals.Summary] = {}
    entries: list[MemberRecord] = []
    for number in run.numbers:
        summary = seals.opened(run.member(number))
        old = known.get(number)
        digest = files.digest(files.member_directory(run.path, number) / files.WEIGHTS)
        if old is not None and (summary is None or (old.files or {}).get(files.WEIGHTS) == digest):
            entries.append(old)
        elif summary is not None:
            entries.append(summary.record(number))
        if summary is not None:
            summaries[number] = summary
    if entries == list(run.fit.members) or len(summaries) < len(run.numbers):
        return run
    starts = {learnable.name: learnable.start for learnable in run.model.learnables}
    constants = {name: _constant(name, start, list(summaries.values())) for name, start in starts.items()}
    noise = {
        name: _mean([s.noise.get(name) for s in summaries.values()])
        for name in (channel.name for channel in run.model.channels)
    }
    state = (
        "is being trained by another process" if trained_now else "training was interrupted; `--resume` continues it"
    )
    going_on = [f"member {n}: {state}" for n in summaries if not summaries[n].finished]
    fit = replace(
        run.fit,
        members=tuple(entries),
        constants={name: record for name, record in constants.items() if record is not None},
        noise=noise,
        warnings=tuple(going_on),
        correlations={},
        step_checks=(),
    )
    return replace(run, fit=fit)


def _constant(name: str, start: float, summaries: Sequence[seals.Summary]) -> ConstantRecord | None:
    values = [s.constants[name] for s in summaries if name in s.constants]
    if len(values) < len(summaries):
        return None
    return ConstantRecord(float(np.mean(values)), None, None, start, tuple(values))


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def member_numbers(directory: Path) -> tuple[int, ...]:
    """The members of a run that have weights, in order."""
    folder = directory / files.MEMBERS
    found = folder.iterdir() if folder.is_dir() else ()
    return tuple(sorted(int(d.name) for d in found if _is_number(d.name) and (d / files.WEIGHTS).is_file()))


def _is_number(name: str) -> bool:
    """Whether a folder is named like one of a member: `²` and `007` are not."""
    return name.isascii() and name.isdigit() and str(int(name)) == name
