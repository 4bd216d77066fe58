"""Opening a run directory: its model, its members' weights, the results of the fit, and predictions of all members."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import GeneratedModule, load_module
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.frontend import load_model
from gbspec.ir import METHODS, Method, Model
from gbspec.runs import files
from gbspec.runs.covariance import Certainties, read_certainties
from gbspec.runs.record import DAMAGED, FitRecord, read_record


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
                self._loaded[number] = self._set(self.module.load(self.path, number))
            except (ValueError, OSError, KeyError) as error:
                message = f"the weights of member {number} of `{self.path}` cannot be read: {error}"
                help_text = "train again, or restore the file from a copy"
                raise UserError([Diagnostic("GB853", message, None, help=help_text)]) from None
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
            self._certainties[number] = read_certainties(files.member_directory(self.path, number))
        return self._certainties[number]

    @cached_property
    def _certainties(self) -> dict[int, Certainties]:
        return {}

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
        """The number of the member with the smallest loss."""
        losses = {n: m.loss for n, m in zip(self.numbers, self.fit.members, strict=False) if m.loss is not None}
        return min(losses, key=lambda n: losses[n]) if losses else self.numbers[0]

    def mean(self, predict: Callable[[GeneratedModule], Array]) -> Array:
        """The mean over members of the result of `predict` (module instance -> array)."""
        return np.asarray(np.mean([predict(member) for member in self.members], axis=0), dtype=np.float64)

    def standard_deviation(self, predict: Callable[[GeneratedModule], Array]) -> Array:
        """The standard deviation over members of the result of `predict` (zero for a single member)."""
        return np.asarray(np.std([predict(member) for member in self.members], axis=0), dtype=np.float64)

    @property
    def max_step(self) -> float | None:
        """The largest step of the solver in training."""
        value = self.member(self.numbers[0]).info.get("max_step")
        return float(value) if value is not None else None

    def history(self) -> list[dict[str, str]]:
        """The rows of `history.csv`; empty if there is no such file."""
        import csv

        path = self.path / files.HISTORY
        if not path.is_file():
            return []
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))


def open_run(path: str | Path, warnings: Findings | None = None) -> Run:
    """Reads a run directory; that it is of an older version is added to `warnings` (GB857).

    Raises `UserError`: GB851 if it is not a run, GB852 if one of its files is missing or damaged, GB857 if it has
    another version of the generated module, GB853 if no member has weights; also with the errors of its `model.gb`.
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
    if fit is None or findings.failed:
        raise UserError(findings)
    if warnings is not None:
        warnings.extend(findings)
    model = load_model(directory / files.MODEL, Findings())
    numbers = member_numbers(directory)
    if not numbers:
        message = f"no member of the run `{directory}` has weights"
        help_text = "its training stopped before the first iteration; train again (`--resume` continues)"
        raise UserError([Diagnostic("GB853", message, None, help=help_text)])
    return Run(directory, model, fit, numbers)


def member_numbers(directory: Path) -> tuple[int, ...]:
    """The members of a run that have weights, in order."""
    folder = directory / files.MEMBERS
    found = folder.iterdir() if folder.is_dir() else ()
    return tuple(sorted(int(d.name) for d in found if d.name.isdigit() and (d / files.WEIGHTS).is_file()))
