"""A fitted run of the Python interface, and how data are given to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, Unpack

from gbspec.data import SimulateOptions
from gbspec.diagnostics import Diagnostic, Findings
from gbspec.frames import Tabled, of_rows
from gbspec.given import WRITTEN, require_path
from gbspec.ir import Model
from gbspec.keywords import SimulateKeywords, options_of, with_near_names
from gbspec.operations import analysing, evaluating, exporting, fitting, models, reporting, tables

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike

    from gbspec.analysis import Diagram, Eigen, Forecast, InitialStates, PlaneDiagram, Validation
    from gbspec.backends import GeneratedModule
    from gbspec.data import Frame, Trajectories
    from gbspec.exports import Precision
    from gbspec.operations import Evaluation, Export, ExportForm
    from gbspec.runs import Run
    from gbspec.training import Profile

Data: TypeAlias = "str | Path | Trajectories | Frame"
"""A path, trajectories, or a table in memory: a data frame, or a mapping of names to columns."""


@with_near_names
@dataclass(frozen=True, repr=False)
class FittedRun(Tabled):
    """A trained run directory. `run` has its model, members and `run.fit`, a `FitRecord` (`fit.json`)."""

    run: Run

    def __str__(self) -> str:
        constants = ", ".join(f"{name} = {value}" for name, value in self.constants.items())
        return f"{self.run.model.name} in {self.run.path}: " + (constants or "no learned constants")

    @property
    def constants(self) -> dict[str, float]:
        """The learned constants in their units, as means over members."""
        return {name: entry.value for name, entry in self.run.fit.constants.items()}

    def to_frame(self) -> pl.DataFrame:
        """The learned constants: `constant`, `value`, `sd`, `low` and `high` of the 90 % interval, `start`, `unit`.

        A constant per trajectory has a further row for each, with its label in `trajectory`.
        """
        from gbspec.report import constant_rows

        return of_rows(constant_rows(self.run))

    def notes(self) -> Sequence[str]:
        """The warnings of the fit."""
        return self.run.fit.warnings

    def history(self) -> pl.DataFrame:
        """The content of `history.csv`: one row for each iteration of each member, with loss and constants."""
        import polars as pl

        return pl.read_csv(self.run.path / "history.csv", infer_schema_length=None)

    def function(self, name: str, points: Frame | ArrayLike) -> pl.DataFrame:
        """A learned function at points, in its units: its arguments, `value`, and `low` and `high` of its 90 % band.

        `points` is a table with a column for each argument, or a list or array [P, A] with them in their order. The
        band is null where the fit does not know it.
        """
        return analysing.function_frame(self.run, name, points)

    def member(self, number: int | None = None) -> GeneratedModule:
        """The generated module with a member's weights (default: the best member's)."""
        return self.run.member(self.run.best if number is None else number)

    def validate(self, data: Data | None = None, *, member: int | Literal["mean"] = "mean") -> Validation:
        """Errors on data (default: the training data), at half the step, and against the truth."""
        findings = Findings()
        found = analysing.validate(self.run, self._data(data, findings), member)
        return replace(found, warnings=(*_messages(findings), *found.warnings))

    @options_of(SimulateOptions)
    def simulate(
        self,
        path: str | Path | None = None,
        *,
        like: Data | None = None,
        values: Mapping[str, float] | None = None,
        member: int | None = None,
        **options: Unpack[SimulateKeywords],
    ) -> Trajectories:
        """Simulated measurements from the learned model, in the model's units; times are in that of its time."""
        return simulated(models.learned(self.run, values, member), path, like, SimulateOptions(**options))

    def export(
        self,
        path: str | Path,
        as_: ExportForm,
        *,
        verify: bool = True,
        precision: Precision = "float64",
        part: str | None = None,
        data: Data | None = None,
        values: Mapping[str, float] | None = None,
        member: int | None = None,
    ) -> Export:
        """Writes the learned model for other programs; see `gbspec export`. Compared with the generated module first.

        `precision` and `part` are those of ONNX graphs, `data` is the table of a PEtab problem.
        Raises `UserError` for what the form cannot express (GB808),
        `ComputationError` if the export differs from the generated module.
        """
        require_path(path, WRITTEN)
        subject = models.learned(self.run, values, member)
        table = None if data is None else tables.read_for_subject(subject, data, Findings())
        return exporting.exported(
            subject, path, as_, str(self.run.path), verify=verify, precision=precision, part=part, data=table
        )

    def evaluate(
        self, data: Data | None = None, *, values: Mapping[str, float] | None = None, member: int | None = None
    ) -> Evaluation:
        """Negative log likelihood, chi-squared, residuals and gradient (default: on the training data, of the best
        member), at what was learned, with `values` in place of some constants; see `gbspec evaluate`."""
        findings = Findings()
        table = (
            tables.trained_on(self.run, None, findings) if data is None else tables.read_for(self.run, data, findings)
        )
        found = evaluating.of_run(self.run, table, values, member)
        return replace(found, warnings=(*_undecided(findings), *found.warnings))

    def eigen(
        self,
        *,
        at: Mapping[str, float] | Sequence[Mapping[str, float]] = (),
        along: Data | None = None,
        steady: bool = False,
        values: Mapping[str, float] | None = None,
        member: int | None = None,
    ) -> Eigen:
        """Eigenvalues of the learned Jacobian, together with the truth's if there is one."""
        data = None if along is None else tables.read_for(self.run, along, Findings())
        return analysing.eigen(models.learned(self.run, values, member), at=at, along=data, steady=steady)

    def predict(self, data: Data, path: str | Path | None = None, *, window: int | None = None) -> Forecast:
        """Predictions for new trajectories from their first `window` measured rows (1: the first row only)."""
        findings = Findings()
        table = tables.read_for(self.run, data, findings, require_channels=False)
        found = analysing.predict(self.run, table, window=window, path=path)
        return replace(found, warnings=(*_messages(findings), *found.warnings))

    def bifurcate(
        self,
        over: str,
        low: float,
        high: float,
        *,
        cycles: bool = True,
        doublings: int = 1,
        values: Mapping[str, float] | None = None,
        member: int | None = None,
    ) -> Diagram:
        """The bifurcation diagram of the learned model over a condition, input or constant, as for a model."""
        subject = models.learned(self.run, values, member)
        return analysing.bifurcate(subject, over, low, high, cycles=cycles, doublings=doublings)

    def bifurcation_plane(
        self,
        first: tuple[str, float, float],
        second: tuple[str, float, float],
        *,
        values: Mapping[str, float] | None = None,
        member: int | None = None,
    ) -> PlaneDiagram:
        """Hopf and fold curves of the learned model over two parameters, each given as (name, low, high)."""
        names, boxes = (first[0], second[0]), (first[1:], second[1:])
        return analysing.bifurcation_plane(models.learned(self.run, values, member), names, boxes)

    def initial_states(self, data: Data | None = None, *, member: int | None = None) -> InitialStates:
        """Learned, bred and true initial states of the training trajectories."""
        table = tables.trained_on(self.run, data, Findings())
        return analysing.initial_states(models.learned(self.run, None, member), table)

    def learned_starts(self, data: Data | None = None, *, member: int | None = None) -> pl.DataFrame:
        """What solutions of the training trajectories begin with, one row for each: `trajectory`, `time`, the states,
        and the constants that trajectories have of their own; in the model's units.

        The table of the training is read again for the conditions and first values in it, unless `data` are given;
        trajectories that were held out have no row.
        """
        table = tables.trained_on(self.run, data, Findings())
        return analysing.learned_starts(models.learned(self.run, None, member), table)

    def plot(
        self,
        kind: str,
        path: str | Path | None = None,
        *,
        data: Data | None = None,
        show: Sequence[str] = (),
    ) -> Figure:
        """A figure of one of the kinds of `gbspec plot`, also written to `path` if given."""
        from gbspec.report import save

        made = reporting.figure(kind, self.run, self._data(data, Findings(), required=False), show)
        if path is not None:
            save(made, path)
        return made

    def profile(
        self,
        name: str,
        path: str | Path | None = None,
        *,
        data: Data | None = None,
        member: int | None = None,
        points: int = 6,
        iterations: int = 60,
    ) -> Profile:
        """The profile likelihood of a learned constant; its figure is written to `path` if given."""
        from gbspec.report import save

        table = tables.trained_on(self.run, data, Findings())
        found = fitting.profile(self.run, name, table, member=member, points=points, iterations=iterations)
        if path is not None:
            save(reporting.profile_figure(self.run, found), path)
        return found

    def report(
        self,
        path: str | Path | None = None,
        *,
        data: Data | None = None,
        diagram: tuple[str, float, float] | None = None,
        cycles: bool = False,
    ) -> Path:
        """Writes the page of `gbspec report` (by default `report.html` in the run) and returns its path."""
        if path is not None:
            require_path(path, WRITTEN)
        target = self.run.path / "report.html" if path is None else Path(path)
        reporting.report(self.run, self._data(data, Findings()), target, diagram=diagram, cycles=cycles)
        return target

    def _data(self, data: Data | None, findings: Findings, *, required: bool = True) -> Trajectories | None:
        if data is not None:
            return tables.read_for(self.run, data, findings)
        return tables.training_data(self.run, findings, required=required)


def _undecided(findings: Findings) -> tuple[Diagnostic, ...]:
    """What was found out about data that may be those of the training, whose table is gone or was changed."""
    return tuple(one for one in findings if one.code == "GB859")


def _messages(findings: Findings) -> tuple[str, ...]:
    return tuple(one.message for one in _undecided(findings))


def table_of(data: Data, model: Model, *, require_channels: bool = True) -> Trajectories:
    """Data of any form as trajectories for a model. Raises `UserError` with all errors in a table."""
    from gbspec.data import Trajectories

    if isinstance(data, Trajectories):
        return data
    return tables.read_data(data, model, Findings(), require_channels=require_channels)


def simulated(
    subject: models.Subject, path: str | Path | None, like: Data | None, options: SimulateOptions
) -> Trajectories:
    """Simulated measurements of a subject, also written to `path` if given; `like` is a table whose times they have."""
    from gbspec.data import write

    rows = None if like is None else table_of(like, subject.model, require_channels=False)
    made = tables.simulate(subject, options, rows)
    if path is not None:
        write(path, made, subject.model)
    return made
