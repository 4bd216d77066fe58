"""The Python interface: models and runs as objects whose methods are named like the commands.

    model = gbspec.load("urp_gb2")
    data = model.simulate(trajectories=50, sampling="gamma", seed=1)
    run = model.train(data, "my_run")
    print(run.validate(data))
    run.plot("functions", "functions.png")

Data are a path, a data frame of polars, pandas or pyarrow, a mapping of names to columns, or what `simulate` returns.
Results have `.to_frame()`, a polars data frame, and show themselves in a notebook.

Errors in models, tables and options raise `gbspec.UserError`, whose `diagnostics` describe them and their places;
computations that fail raise `gbspec.ComputationError`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack, overload

from gbspec import frontend
from gbspec.data import SimulateOptions
from gbspec.diagnostics import Diagnostic, Findings
from gbspec.fitted import Data, FittedRun, simulated, table_of
from gbspec.frames import Tabled, of_rows
from gbspec.given import WRITTEN, require_path
from gbspec.ir import Model
from gbspec.json_values import JsonObject
from gbspec.keywords import (
    SimulateKeywords,
    StudyKeywords,
    TrainKeywords,
    near_names,
    options_of,
    with_near_names,
)
from gbspec.operations import analysing, evaluating, exporting, fitting, importing, models
from gbspec.report import progress_of, register
from gbspec.studies import StudyOptions
from gbspec.training import TrainOptions

register()

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

    from gbspec.analysis import Diagram, Eigen, Validation
    from gbspec.data import Trajectories
    from gbspec.exports import Precision
    from gbspec.operations import Evaluation, Export, ExportForm, Import
    from gbspec.studies import CrossValidation
    from gbspec.training import Progress


_DIRECTORY = "what is fitted is written to a directory, which is given by its path"


@with_near_names
@dataclass(frozen=True, repr=False)
class Specification(Tabled):
    """A `.gb` model that was read and checked, with its `warnings`."""

    path: str
    model: Model
    warnings: tuple[Diagnostic, ...] = ()

    def __str__(self) -> str:
        from gbspec.diagnostics import render_text
        from gbspec.report import model_summary

        return "\n".join(part for part in (model_summary(self.model), render_text(self.warnings)) if part)

    def to_frame(self) -> pl.DataFrame:
        """What the model declares: `name`, `role`, `value` (or start), `low` and `high`, `unit`, `description`."""
        from gbspec.report import declared_rows

        return of_rows(declared_rows(self.model))

    def summary(self) -> str:
        """Name and title."""
        return self.model.name + (f": {self.model.title}" if self.model.title else "")

    def notes(self) -> Sequence[str]:
        """The warnings."""
        return [f"warning[{found.code}]: {found.message}" for found in self.warnings]

    def check(self) -> tuple[Diagnostic, ...]:
        """The warnings, including those on identifiability; errors were raised when the model was loaded."""
        from gbspec.passes import examine

        findings = Findings(self.warnings)
        examine(self.model, findings)
        return tuple(findings)

    @overload
    def compile(self, path: str | Path | None = None, *, solver: str = "rk4") -> str: ...

    @overload
    def compile(self, path: str | Path | None = None, *, emit: str, solver: str = "rk4") -> str | bytes: ...

    def compile(self, path: str | Path | None = None, *, emit: str = "module", solver: str = "rk4") -> str | bytes:
        """The model in a form of `gbspec compile --emit`, also written to `path` if given; bytes for a binary form.

        `solver` names the integration method. Raises `ValueError` if there is no such form, `UserError` if the form
        cannot represent the model (GB808) or there is no such solver (GB850).
        """
        from gbspec.files import write_bytes

        if emit not in models.forms():
            raise ValueError(f"there is no form `{emit}`; there are {', '.join(models.forms())}")
        made = models.compile_model(self.model, emit, solver).content
        if path is not None:
            write_bytes(path, made if isinstance(made, bytes) else made.encode("utf-8"))
        return made

    @options_of(SimulateOptions)
    def simulate(
        self,
        path: str | Path | None = None,
        *,
        like: Data | None = None,
        values: Mapping[str, float] | None = None,
        **options: Unpack[SimulateKeywords],
    ) -> Trajectories:
        """Simulated measurements from the model's truth, in the model's units; times are in that of its time."""
        return simulated(models.reference(self.model, values), path, like, SimulateOptions(**options))

    @options_of(TrainOptions)
    def train(
        self,
        data: Data,
        directory: str | Path,
        *,
        values: Mapping[str, float] | None = None,
        progress: Progress | bool | None = None,
        **options: Unpack[TrainKeywords],
    ) -> FittedRun:
        """Fits learnables and unknowns to data, into a run directory.

        The progress is shown in a notebook and, with `progress=True`, elsewhere; a `Progress` receives it instead.
        """
        require_path(directory, _DIRECTORY)
        model = models.specified(self.model, values or {})
        table = table_of(data, model)
        with progress_of(progress) as shown:
            made = fitting.train(model, table, Path(directory), TrainOptions(**options), shown)
        return FittedRun(made)

    @options_of(TrainOptions)
    def crossvalidate(
        self,
        data: Data,
        directory: str | Path,
        *,
        folds: int | None = None,
        over: Literal["trajectories", "time"] | None = None,
        window: int | None = None,
        progress: Progress | bool | None = None,
        **options: Unpack[TrainKeywords],
    ) -> CrossValidation:
        """Errors of predictions of held-out data, fold by fold, in the units of the channels; see `train`."""
        from gbspec.studies import CrossOptions, crossvalidate

        require_path(directory, _DIRECTORY)
        division, table, chosen = CrossOptions(folds, over, window), table_of(data, self.model), TrainOptions(**options)
        with progress_of(progress) as shown:
            return crossvalidate(self.model, table, Path(directory), chosen, division, lambda fold: shown)

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
    ) -> Export:
        """Writes the model at its truth for other programs; see `FittedRun.export`."""
        require_path(path, WRITTEN)
        subject = models.reference(self.model, values)
        table = None if data is None else table_of(data, self.model)
        return exporting.exported(
            subject, path, as_, self.path, verify=verify, precision=precision, part=part, data=table
        )

    def evaluate(self, data: Data, *, values: Mapping[str, float] | None = None) -> Evaluation:
        """Negative log likelihood, chi-squared, residuals and gradient on data at a point.

        Learnables are at `values`, else at their truths, else at their starts; see `gbspec evaluate`.
        """
        return evaluating.of_model(self.model, table_of(data, self.model), values)

    def eigen(
        self,
        *,
        at: Mapping[str, float] | Sequence[Mapping[str, float]] = (),
        along: Data | None = None,
        steady: bool = False,
        values: Mapping[str, float] | None = None,
    ) -> Eigen:
        """Eigenvalues of the truth's Jacobian at points, along data, or at steady states."""
        data = None if along is None else table_of(along, self.model)
        return analysing.eigen(models.reference(self.model, values), at=at, along=data, steady=steady)

    def bifurcate(
        self,
        over: str,
        low: float,
        high: float,
        *,
        cycles: bool = True,
        doublings: int = 1,
        values: Mapping[str, float] | None = None,
    ) -> Diagram:
        """The bifurcation diagram of the truth over a condition, input or constant.

        At period doublings the doubled cycles are followed too, at most `doublings` times.
        """
        subject = models.reference(self.model, values)
        return analysing.bifurcate(subject, over, low, high, cycles=cycles, doublings=doublings)


@near_names
def load(path: str | Path) -> Specification:
    """Reads and checks a model file, or a bundled model by name. Raises `UserError` with all diagnostics on errors."""
    findings = Findings()
    model = frontend.load_model(path, findings)
    return Specification(str(path), model, tuple(findings))


@near_names
def check(path: str | Path) -> tuple[Diagnostic, ...]:
    """All errors and warnings of a model file, in the order of the text; raises nothing."""
    from gbspec.diagnostics import UserError
    from gbspec.passes import examine

    findings = Findings()
    try:
        examine(frontend.load_model(path, findings), findings)
    except UserError as error:
        findings.extend(error.diagnostics)
    return tuple(findings)


@near_names
def open_run(path: str | Path) -> FittedRun:
    """Opens a run directory. Raises `UserError` if it is not one."""
    return FittedRun(models.open_run(path))


@options_of(SimulateOptions)
def simulate(
    source: str | Path,
    path: str | Path | None = None,
    *,
    like: Data | None = None,
    values: Mapping[str, float] | None = None,
    **options: Unpack[SimulateKeywords],
) -> Trajectories:
    """Simulated measurements from a model's truth or from a run, by path; see `Specification.simulate`."""
    return _subject(source).simulate(path, like=like, values=values, **options)


@options_of(TrainOptions)
def train(
    model: str | Path,
    data: Data,
    directory: str | Path,
    *,
    values: Mapping[str, float] | None = None,
    progress: Progress | bool | None = None,
    **options: Unpack[TrainKeywords],
) -> FittedRun:
    """Trains a model file on data, into a run directory; see `Specification.train`."""
    return load(model).train(data, directory, values=values, progress=progress, **options)


@near_names
def import_model(path: str | Path, directory: str | Path) -> Import:
    """Imports a model of another format (SBML, PEtab) into a folder; see `gbspec import`.

    Raises `UserError` with all reasons if the language cannot express it.
    """
    return importing.import_file(path, directory)


@near_names
def validate(run: str | Path, data: Data | None = None) -> Validation:
    """Errors of a run, by path; see `FittedRun.validate`."""
    return open_run(run).validate(data)


@near_names
def evaluate(source: str | Path, data: Data, *, values: Mapping[str, float] | None = None) -> Evaluation:
    """The objective of a model or of a run on data at a point, by path; see `Specification.evaluate`."""
    return _subject(source).evaluate(data, values=values)


@near_names
def bifurcate(
    source: str | Path,
    over: str,
    low: float,
    high: float,
    *,
    cycles: bool = True,
    doublings: int = 1,
    values: Mapping[str, float] | None = None,
) -> Diagram:
    """The bifurcation diagram of a model's truth or of a run, by path; see `Specification.bifurcate`."""
    return _subject(source).bifurcate(over, low, high, cycles=cycles, doublings=doublings, values=values)


@near_names
def figure(result: object) -> Figure:
    """The figure of a diagram, of curves in a plane, of eigenvalues, of initial states or of a profile."""
    from gbspec.report import figure as draw

    return draw(result)


@options_of(StudyOptions)
def study(cases: str | Sequence[str], directory: str | Path, **options: Unpack[StudyKeywords]) -> JsonObject:
    """Fits cases many times into a directory and returns the content of its `study.json`; see `gbspec study`.

    Workers are separate processes: a script that calls this with data to fit needs `if __name__ == "__main__":`.
    """
    from gbspec.studies import run_study, study_of

    chosen = StudyOptions(**options)
    named = [cases] if isinstance(cases, str) else list(cases)
    command = f"gbspec.study({cases!r})"
    return run_study(study_of(named, chosen), Path(directory), chosen, command, lambda *_: None).to_json()


def _subject(source: str | Path) -> Specification | FittedRun:
    return open_run(source) if models.is_run(source) else load(source)
