"""The Python interface: models and runs as objects whose methods are named like the commands.

    model = gbspec.load("urp_gb2")
    data = model.simulate(trajectories=50, sampling="gamma", seed=1)
    run = model.train(data, "my_run")
    print(run.validate(data))
    run.plot("functions", "functions.png")

Errors in models, tables and options raise `gbspec.diagnostics.UserError`, whose `diagnostics` describe them and their
places; computations that fail raise `gbspec.diagnostics.ComputationError`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, overload

from gbspec import frontend
from gbspec.diagnostics import Diagnostic, Findings
from gbspec.ir import Model
from gbspec.json_values import JsonObject
from gbspec.operations import analysing, fitting, models, reporting, tables
from gbspec.report import register

register()

Option: TypeAlias = Any
"""The value of an option: of the type of the field that it names."""

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gbspec.analysis import Diagram, Eigen, Forecast, InitialStates, PlaneDiagram, Validation
    from gbspec.backends import GeneratedModule
    from gbspec.data import Trajectories
    from gbspec.runs import Run
    from gbspec.studies import CrossValidation
    from gbspec.training import Profile, Progress


@dataclass(frozen=True)
class Specification:
    """A `.gb` model that was read and checked, with its `warnings`."""

    path: str
    model: Model
    warnings: tuple[Diagnostic, ...] = ()

    def __str__(self) -> str:
        from gbspec.diagnostics import render_text
        from gbspec.report import model_summary

        return "\n".join(part for part in (model_summary(self.model), render_text(self.warnings)) if part)

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

    def simulate(
        self,
        path: str | Path | None = None,
        *,
        like: str | Path | Trajectories | None = None,
        values: Mapping[str, float] | None = None,
        **options: Option,
    ) -> Trajectories:
        """Simulated measurements from the model's truth; `options` are the fields of `SimulateOptions`."""
        return _simulate(models.reference(self.model, values), path, like, options)

    def train(
        self,
        data: str | Path | Trajectories,
        directory: str | Path,
        *,
        values: Mapping[str, float] | None = None,
        progress: Progress | None = None,
        **options: Option,
    ) -> FittedRun:
        """Fits learnables and unknowns to data, into a run directory; `options` are the fields of `TrainOptions`."""
        from gbspec.training import TrainOptions

        model = models.specified(self.model, values or {})
        made = fitting.train(model, _table(data, model), Path(directory), TrainOptions(**options), progress)
        return FittedRun(made)

    def crossvalidate(
        self,
        data: str | Path | Trajectories,
        directory: str | Path,
        *,
        folds: int | None = None,
        over: Literal["trajectories", "time"] | None = None,
        window: int | None = None,
        progress: Progress | None = None,
        **options: Option,
    ) -> CrossValidation:
        """Errors of predictions of held-out data, fold by fold; `options` are the fields of `TrainOptions`."""
        from gbspec.studies import CrossOptions, crossvalidate
        from gbspec.training import Silent, TrainOptions

        shown, division = progress or Silent(), CrossOptions(folds, over, window)
        table = _table(data, self.model)
        return crossvalidate(self.model, table, Path(directory), TrainOptions(**options), division, lambda fold: shown)

    def eigen(
        self,
        *,
        at: Sequence[Mapping[str, float]] = (),
        along: str | Path | Trajectories | None = None,
        steady: bool = False,
        values: Mapping[str, float] | None = None,
    ) -> Eigen:
        """Eigenvalues of the truth's Jacobian at points, along data, or at steady states."""
        data = None if along is None else _table(along, self.model)
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


@dataclass(frozen=True)
class FittedRun:
    """A trained run directory. `run` has its model, members and `run.fit`, a `FitRecord` (`fit.json`)."""

    run: Run

    def __str__(self) -> str:
        constants = ", ".join(f"{name} = {value}" for name, value in self.constants.items())
        return f"{self.run.model.name} in {self.run.path}: " + (constants or "no learned constants")

    @property
    def constants(self) -> dict[str, float]:
        """The learned constants, as means over members."""
        return {name: entry.value for name, entry in self.run.fit.constants.items()}

    def member(self, number: int | None = None) -> GeneratedModule:
        """The generated module with a member's weights (default: the best member's)."""
        return self.run.member(self.run.best if number is None else number)

    def validate(
        self, data: str | Path | Trajectories | None = None, *, member: int | Literal["mean"] = "mean"
    ) -> Validation:
        """Errors on data (default: the training data), at half the step, and against the truth."""
        return analysing.validate(self.run, self._data(data), member)

    def simulate(
        self,
        path: str | Path | None = None,
        *,
        like: str | Path | Trajectories | None = None,
        values: Mapping[str, float] | None = None,
        member: int | None = None,
        **options: Option,
    ) -> Trajectories:
        """Simulated measurements from the learned model; `options` are the fields of `SimulateOptions`."""
        return _simulate(models.learned(self.run, values, member), path, like, options)

    def eigen(
        self,
        *,
        at: Sequence[Mapping[str, float]] = (),
        along: str | Path | Trajectories | None = None,
        steady: bool = False,
        values: Mapping[str, float] | None = None,
        member: int | None = None,
    ) -> Eigen:
        """Eigenvalues of the learned Jacobian, together with the truth's if there is one."""
        data = None if along is None else _table(along, self.run.model)
        return analysing.eigen(models.learned(self.run, values, member), at=at, along=data, steady=steady)

    def predict(
        self, data: str | Path | Trajectories, path: str | Path | None = None, *, window: int | None = None
    ) -> Forecast:
        """Predictions for new trajectories from their first `window` measured rows (1: the first row only)."""
        table = data
        if isinstance(table, str | Path):
            table = tables.read_data(table, self.run.model, Findings(), require_channels=False)
        return analysing.predict(self.run, table, window=window, path=path)

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

    def initial_states(self, data: str | Path | None = None, *, member: int | None = None) -> InitialStates:
        """Learned, bred and true initial states of the training trajectories."""
        table = tables.trained_on(self.run, data, Findings())
        return analysing.initial_states(models.learned(self.run, None, member), table)

    def plot(
        self,
        kind: str,
        path: str | Path | None = None,
        *,
        data: str | Path | Trajectories | None = None,
        show: Sequence[str] = (),
    ) -> Figure:
        """A figure of one of the kinds of `gbspec plot`, also written to `path` if given."""
        from gbspec.report import save

        made = reporting.figure(kind, self.run, self._data(data, required=False), show)
        if path is not None:
            save(made, path)
        return made

    def profile(
        self,
        name: str,
        path: str | Path | None = None,
        *,
        data: str | Path | None = None,
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
        data: str | Path | Trajectories | None = None,
        diagram: tuple[str, float, float] | None = None,
        cycles: bool = False,
    ) -> Path:
        """Writes the page of `gbspec report` (by default `report.html` in the run) and returns its path."""
        target = self.run.path / "report.html" if path is None else Path(path)
        reporting.report(self.run, self._data(data), target, diagram=diagram, cycles=cycles)
        return target

    def _data(self, data: str | Path | Trajectories | None, *, required: bool = True) -> Trajectories | None:
        if data is not None:
            return _table(data, self.run.model)
        return tables.training_data(self.run, Findings(), required=required)


def load(path: str | Path) -> Specification:
    """Reads and checks a model file, or a bundled model by name. Raises `UserError` with all diagnostics on errors."""
    findings = Findings()
    model = frontend.load_model(path, findings)
    return Specification(str(path), model, tuple(findings))


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


def open_run(path: str | Path) -> FittedRun:
    """Opens a run directory. Raises `UserError` if it is not one."""
    return FittedRun(models.open_run(path))


def simulate(source: str | Path, path: str | Path | None = None, **options: Option) -> Trajectories:
    """Simulated measurements from a model's truth or from a run, by path; see `Specification.simulate`."""
    subject: Specification | FittedRun = open_run(source) if models.is_run(source) else load(source)
    return subject.simulate(path, **options)


def train(model: str | Path, data: str | Path | Trajectories, directory: str | Path, **options: Option) -> FittedRun:
    """Trains a model file on data, into a run directory; see `Specification.train`."""
    return load(model).train(data, directory, **options)


def validate(run: str | Path, data: str | Path | Trajectories | None = None) -> Validation:
    """Errors of a run, by path; see `FittedRun.validate`."""
    return open_run(run).validate(data)


def bifurcate(source: str | Path, over: str, low: float, high: float, **options: Option) -> Diagram:
    """The bifurcation diagram of a model's truth or of a run, by path; see `Specification.bifurcate`."""
    subject: Specification | FittedRun = open_run(source) if models.is_run(source) else load(source)
    return subject.bifurcate(over, low, high, **options)


def figure(result: object) -> Figure:
    """The figure of a diagram, of curves in a plane, of eigenvalues, of initial states or of a profile."""
    from gbspec.report import figure as draw

    return draw(result)


def study(cases: str | Sequence[str], directory: str | Path, **options: Option) -> JsonObject:
    """Fits cases many times into a directory and returns the content of its `study.json`; see `gbspec study`.

    `options` are the fields of `StudyOptions`. Workers are separate processes: a script that calls this with data
    to fit needs `if __name__ == "__main__":`.
    """
    from gbspec.studies import StudyOptions, run_study, study_of

    chosen = StudyOptions(**options)
    named = [cases] if isinstance(cases, str) else list(cases)
    command = f"gbspec.study({cases!r})"
    return run_study(study_of(named, chosen), Path(directory), chosen, command, lambda *_: None).to_json()


def _table(data: str | Path | Trajectories, model: Model) -> Trajectories:
    return tables.read_data(data, model, Findings()) if isinstance(data, str | Path) else data


def _simulate(
    subject: models.Subject,
    path: str | Path | None,
    like: str | Path | Trajectories | None,
    options: Mapping[str, Option],
) -> Trajectories:
    from gbspec.data import SimulateOptions, write

    if isinstance(like, str | Path):
        like = tables.read_data(like, subject.model, Findings(), require_channels=False)
    made = tables.simulate(subject, SimulateOptions(**options), like)
    if path is not None:
        write(path, made, subject.model)
    return made
