"""The pipeline: from a path to a Model, from a Model to an evaluator, data, a trained run, and what it says.

Every stage is imported when it is used, so that checking a model loads neither torch nor casadi.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gbspec.diagnostics import Findings, Source, UserError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gbspec.analysis.bifurcation.diagram import Diagram
    from gbspec.analysis.bifurcation.eigen import Eigen
    from gbspec.analysis.bifurcation.plane_diagram import PlaneDiagram
    from gbspec.analysis.prediction.forecast import Forecast
    from gbspec.analysis.prediction.initial_states import InitialStates
    from gbspec.analysis.prediction.predict import Prediction
    from gbspec.analysis.systems.system import Box, System
    from gbspec.analysis.validation.validate import Validation
    from gbspec.backends.casadi.evaluator import Evaluator
    from gbspec.data.sampling import SimulateOptions
    from gbspec.data.trajectories import Trajectories
    from gbspec.ir.model import Model
    from gbspec.runs.store import Run
    from gbspec.training import Progress
    from gbspec.training.options import TrainOptions
    from gbspec.training.profile.likelihood import Profile
    from gbspec.training.runs.variations import Point


# ---------------------------------------------------------------------------------------------- text to Model
def resolve(path: str | Path) -> Path:
    """The path itself where it exists; else the shipped model of that name, if there is one; else the path."""
    from gbspec.data.shipped import shipped_models

    given = Path(path)
    return given if given.exists() else shipped_models().get(str(path), given)


def read_source(path: str | Path) -> Source:
    """The text of a model file. Raises `UserError` (GB001 to GB003) where there is none."""
    from gbspec.syntax.reading import read_source as read

    return read(resolve(path))


def load_model(path: str | Path, findings: Findings, read: Callable[[str | Path], Source] = read_source) -> Model:
    """Reads, parses, checks, lowers and verifies a model.

    Everything found is recorded in `findings` (warnings remain there). Raises `UserError` with all of them if one is an
    error, `Defect` if the Model that comes out is not well formed. `read` gives the text of the file and of those that
    it extends: an editor has newer ones than the disk.
    """
    from gbspec.ir.verify import verify
    from gbspec.lower import lower
    from gbspec.semantics import check
    from gbspec.syntax.parser import parse

    file = parse(read(path), findings)
    checked = check(file, findings, read) if file is not None else None
    findings.raise_if_failed()
    if checked is None:
        raise UserError(findings)
    model = lower(checked, findings)
    findings.raise_if_failed()
    verify(model)
    if model.claims:
        from gbspec.passes.claims import check_claims

        check_claims(model, findings)
    if any(unknown.contracts for unknown in model.unknowns):
        from gbspec.passes.contracts import with_contracts

        model = with_contracts(model, findings)
    findings.raise_if_failed()
    return model


# ------------------------------------------------------------------------------------------- Model to numbers
@dataclass(frozen=True)
class Subject:
    """What can be evaluated: a model at its truth (which stands in `model`), or a run at what it learned.

    `values` are what was set by hand; they stand in `model` and in the evaluator already.
    """

    model: Model
    evaluator: Evaluator
    run: Run | None = None
    values: Mapping[str, float] = field(default_factory=dict)


def is_run(path: str | Path) -> bool:
    """Whether a path is meant as a run directory."""
    return Path(path).is_dir()


def open_run(path: str | Path, values: Mapping[str, float] | None = None) -> Run:
    """A trained run, with `values` in place of constants, learned or known, and of conditions' defaults.

    Raises `UserError`: GB851 to GB853 where the path is none, or damaged; GB804 where a name cannot be set.
    """
    from gbspec.runs.store import open_run as open_directory

    return set_values(open_directory(path), values)


def set_values(run: Run, values: Mapping[str, float] | None) -> Run:
    """The run with other values for constants and conditions, in its truth too. Raises `UserError` (GB804)."""
    from gbspec.passes import with_values

    if not values:
        return run
    return replace(run, model=with_values(run.model, values), values={**run.values, **values})


def subject(path: str | Path, values: Mapping[str, float], findings: Findings, member: int | None = None) -> Subject:
    """A MODEL at its truth, or a RUN at what it learned, with `values` put in for constants and conditions."""
    if is_run(path):
        return learned(open_run(path), values, member)
    return reference(load_model(path, findings), values)


def learned(run: Run, values: Mapping[str, float] | None = None, member: int | None = None) -> Subject:
    """What a member of a run learned (the best one where none is named). Raises `UserError` (GB804, GB854)."""
    from gbspec.backends.casadi.evaluator import Evaluator

    run = set_values(run, values)
    instance = run.member(run.best if member is None else member)
    return Subject(run.model, Evaluator(instance), run, run.values)


def reference(model: Model, values: Mapping[str, float] | None = None) -> Subject:
    """A model at its truth. Raises `UserError` (GB803, GB804) naming the unknowns that have none, or wrong `values`."""
    from gbspec.backends.casadi.evaluator import Evaluator
    from gbspec.backends.module import load_module
    from gbspec.passes import with_truth, with_values

    known = with_values(with_truth(model), values or {})
    return Subject(known, Evaluator(load_module(known)()), values=values or {})


# ------------------------------------------------------------------------------------- what the commands are made of
def simulate(
    source: Subject,
    options: SimulateOptions,
    like: Trajectories | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectories:
    """Simulated measurements of a subject; conditions that were set are held there."""
    from gbspec.analysis.simulation.simulate import simulate as run
    from gbspec.data.sampling import fixed

    return run(source.evaluator, source.model, fixed(options, source.values, source.model), like, progress)


def read_data(path: str | Path, model: Model, findings: Findings, *, require_channels: bool = True) -> Trajectories:
    """A table of measurements for a model. Raises `UserError` with everything that is wrong in it."""
    from gbspec.data.table import read

    return read(path, model, findings, require_channels)


def specified(model: Model, values: Mapping[str, float]) -> Model:
    """The model to be trained with other values: its text has them too, so that a run keeps what was computed with.

    A value of a learnable is where its training starts; its truth stays. Raises `UserError`: GB804 where a name is no
    constant, condition or input, and what else is wrong with the model that has these values.
    """
    from gbspec.passes import with_values
    from gbspec.syntax.settings import with_settings

    if not values:
        return model
    with_values(model, values)  # every name is known and every number finite, or this says which is not
    text = with_settings(Source("model.gb", model.text), values)
    return load_model("model.gb", Findings(), lambda _: Source("model.gb", text))


def train(
    model: Model, data: Trajectories, directory: Path, options: TrainOptions, progress: Progress | None = None
) -> Run:
    """Learns what the model leaves open from data, into a run directory; then every fit's step is checked."""
    return with_step_checks(fit(model, data, directory, options, progress), data, options)


def fit(
    model: Model, data: Trajectories, directory: Path, options: TrainOptions, progress: Progress | None = None
) -> Run:
    """The same without the check, for studies, which judge their fits themselves."""
    from gbspec.training import train as run

    return run(model, data, options, directory, progress)


def with_step_checks(run: Run, data: Trajectories, options: TrainOptions) -> Run:
    """The run just fitted to `data`, with the check of each member's step, and a warning of those that lean on it."""
    from gbspec.analysis.validation.step_check import check_fit
    from gbspec.training.recipe.context import split

    if len(data) == 1:  # of one trajectory the last rows are held out; it is known by the others
        data, _ = split(data, options.holdout, options.seed)
    checks = check_fit(run, data)
    leaning = [f"member {k}: {check.warning}" for k, check in zip(run.numbers, checks, strict=True) if check.warning]
    return run.amended(
        step_checks=[check.to_json() for check in checks], warnings=[*run.fit.get("warnings", []), *leaning]
    )


def sweep(
    model: Model,
    data: Trajectories,
    points: Sequence[Point],
    directory: Path,
    options: TrainOptions,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Trains with each point's options into a run directory of its own; a row of results for each."""
    from gbspec.runs.store import member_numbers, open_run
    from gbspec.training.runs.sweep import sweep as run

    rows = run(model, data, points, options, directory, progress)
    for point in points:
        if member_numbers(directory / point.name):
            made = open_run(directory / point.name)
            checked = with_step_checks(made, data, point.options)
            for warning in checked.fit["warnings"][len(made.fit["warnings"]) :]:
                if progress is not None:
                    progress.message(f"{point.name}: {warning}")
    return rows


def eigen(
    source: Subject, *, at: Sequence[Mapping[str, float]] = (), along: Trajectories | None = None, steady: bool = False
) -> Eigen:
    """Eigenvalues of a subject; of a run beside those of its model's truth, where it has one."""
    from gbspec.analysis.bifurcation.eigen import eigen as run

    true = truth_of(source)
    truth = None if true is None else system(true)
    predicted: list[Prediction] = []
    if along is not None:
        from gbspec.analysis.prediction.estimate import predictions

        data = {} if source.run is None else source.run.fit.get("data", {})
        predicted = predictions(source.evaluator, source.model, along, data)
    return run(system(source), truth=truth, at=at, along=along, predicted=predicted, steady=steady)


def initial_states(source: Subject, data: Trajectories, indices: Sequence[int] | None = None) -> InitialStates:
    """Learned, bred and true initial states of a run's trajectories beside each other."""
    from gbspec.analysis.prediction.initial_states import initial_states as run

    true = truth_of(source)
    known = {} if source.run is None else source.run.fit.get("data", {})
    truth = None if true is None else true.evaluator
    return run(source.evaluator, source.model, data, known, system(source), truth, indices)


def truth_of(source: Subject) -> Subject | None:
    """The truth of a run's model with the same values set, None where there is none."""
    from gbspec.analysis.validation.truth_errors import has_reference

    if source.run is None or not has_reference(source.run.model):
        return None
    return reference(source.run.model, source.values)


def bifurcate(
    source: Subject, over: str, low: float, high: float, *, cycles: bool = True, doublings: int = 1
) -> Diagram:
    """The bifurcation diagram of a subject over one of its parameters; cycles double at most `doublings` times."""
    from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions
    from gbspec.analysis.bifurcation.bifurcate import bifurcate as run
    from gbspec.analysis.bifurcation.cycles import CycleOptions

    return run(
        system(source), over, low, high, BifurcationOptions(cycles=cycles, cycle=CycleOptions(doublings=doublings))
    )


def true_diagram(
    source: Subject, over: str, low: float, high: float, *, cycles: bool = True, doublings: int = 1
) -> Diagram | None:
    """The same of the truth of a run's model, None where there is none."""
    truth = truth_of(source)
    return None if truth is None else bifurcate(truth, over, low, high, cycles=cycles, doublings=doublings)


def bifurcation_plane(source: Subject, names: tuple[str, str], boxes: tuple[Box, Box]) -> PlaneDiagram:
    """The Hopf and fold curves of a subject in a box of the plane of two of its parameters."""
    from gbspec.analysis.bifurcation.plane_diagram import bifurcation_plane as run

    return run(system(source), names, boxes)


def true_plane(source: Subject, names: tuple[str, str], boxes: tuple[Box, Box]) -> PlaneDiagram | None:
    """The same of the truth of a run's model, None where there is none."""
    truth = truth_of(source)
    return None if truth is None else bifurcation_plane(truth, names, boxes)


def plane_figure(diagrams: Sequence[PlaneDiagram], truth: PlaneDiagram | None = None) -> Figure:
    """The figure of one or several members' curves, beside the truth's."""
    from gbspec.report.files import plane

    return plane(diagrams[0], diagrams[1:], truth)


def joined(diagrams: Sequence[Diagram]) -> Diagram:
    """The diagram of the first of several members, its special points with intervals over all of them."""
    from gbspec.analysis.bifurcation.members import with_intervals

    return with_intervals(diagrams) if len(diagrams) > 1 else diagrams[0]


def diagram_figure(diagrams: Sequence[Diagram], truth: Diagram | None = None) -> Figure:
    """The figure of one or several members' diagrams, beside the truth's."""
    from gbspec.report.files import diagram

    return diagram(joined(diagrams), diagrams[1:], truth)


def training_data(run: Run, findings: Findings) -> Trajectories | None:
    """The table that a run was trained on, None where it is no longer where it was."""
    path = run.fit.get("data", {}).get("path")
    return read_data(path, run.model, findings) if path and Path(path).is_file() else None


def validate(run: Run, data: Trajectories | None, member: int | Literal["mean"] = "mean") -> Validation:
    """Errors of a run on data, at half its step, by an adaptive solver, and against the truth."""
    from gbspec.analysis.validation.validate import validate as check

    return check(run, data, member=member)


def predict(run: Run, data: Trajectories, *, window: int | None = None, path: str | Path | None = None) -> Forecast:
    """Predictions of a run for a table, from the first `window` measured rows; also written to `path`, if given."""
    from gbspec.analysis.prediction.forecast import forecast
    from gbspec.report.predictions import write

    found = forecast(run, data, window=window)
    if path is not None:
        write(path, found, run.model.time.name)
    return found


def trained_on(run: Run, path: str | Path | None, findings: Findings) -> Trajectories:
    """The data that a run was trained on, from `path` if they were moved. Raises `UserError` (GB859) without them."""
    from gbspec.diagnostics import Diagnostic

    data = training_data(run, findings) if path is None else read_data(path, run.model, findings)
    if data is None:
        where = run.fit.get("data", {}).get("path")
        message = f"the table that the run was trained on, `{where}`, is not where it was"
        raise UserError([Diagnostic("GB859", message, None, help="say where it is now: `--data TABLE`")])
    if data.sha256 != run.fit.get("data", {}).get("sha256"):
        message = f"`{data.path}` is not the table that the run was trained on"
        help = "a profile continues the fit, so it needs the same table, unchanged"
        raise UserError([Diagnostic("GB859", message, None, help=help)])
    return data


def profile(
    run: Run,
    name: str,
    data: Trajectories,
    *,
    member: int | None = None,
    points: int = 6,
    iterations: int = 60,
    progress: Callable[[float, float], None] | None = None,
) -> Profile:
    """The profile likelihood of a learned constant."""
    from gbspec.training.profile.likelihood import profile as follow

    return follow(run, name, data, member=member, points=points, iterations=iterations, progress=progress)


def profile_figure(run: Run, found: Profile) -> Figure:
    """The figure of a profile, with the truth where the model states one."""
    from gbspec.report.files import profile as draw

    truths = {t.name: t.value for t in run.model.truth_constants}
    return draw(found, truths.get(found.name))


def report(
    run: Run,
    data: Trajectories | None,
    path: str | Path,
    *,
    diagram: tuple[str, float, float] | None = None,
    cycles: bool = False,
) -> None:
    """Writes the report of a run as one HTML file; `diagram` names a parameter and its range."""
    from gbspec.files import write_text
    from gbspec.report.collect import Fitted
    from gbspec.report.html.page import Findings as Found
    from gbspec.report.html.page import page

    source = learned(run)
    drawn = None
    if diagram is not None:
        drawn = bifurcate(source, *diagram, cycles=cycles), true_diagram(source, *diagram, cycles=cycles)
    spectra = None if data is None else eigen(source, along=data)
    fitted = None if data is None else Fitted(run, data)
    write_text(path, page(fitted, run, Found(validate(run, data), spectra, drawn)))


def figure(kind: str, run: Run, data: Trajectories | None, show: Sequence[str] = ()) -> Figure:
    """A figure of a run: one of `gbspec.report.kinds`."""
    from gbspec.report.files import draw

    return draw(kind, run, data, show)


def system(source: Subject) -> System:
    """A subject as a dynamical system to analyse."""
    from gbspec.analysis.systems.system import system_of

    return system_of(source.evaluator, source.model)
