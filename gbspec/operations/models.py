"""Opens models and runs for evaluation, with values set by the user, and compiles them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec import frontend
from gbspec.diagnostics import Defect, Findings, Source, packages
from gbspec.given import plain_values, require_path
from gbspec.ir import RK4, Method, method_named

if TYPE_CHECKING:
    from gbspec.analysis import Individuals
    from gbspec.backends import Evaluator
    from gbspec.ir import Model
    from gbspec.runs import Run
    from gbspec.syntax import ModelStatement


@dataclass(frozen=True)
class Subject:
    """A model at its truth (already substituted in `model`), or a `member` of a run at its learned parameters, for
    evaluation.

    `values` are those set by the user; `model` and the evaluator already have them. `individuals` is how constants are
    distributed between trajectories, if they are; the evaluator has the medians.
    """

    model: Model
    evaluator: Evaluator
    run: Run | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    member: int | None = None
    individuals: Individuals | None = None
    origin: Model | None = None
    """The model before its truth was substituted; None of a run."""


@dataclass(frozen=True)
class Compiled:
    """A model in another form; `class_name` is that of its generated module, None for a stage of the pipeline."""

    name: str
    content: str | bytes
    class_name: str | None


def is_run(path: str | Path) -> bool:
    """Whether a path denotes a run directory. Raises TypeError for what is no path."""
    require_path(path, "a model or a run is given by its path, or a bundled model by its name")
    return Path(path).is_dir()


def open_run(path: str | Path, values: Mapping[str, float] | None = None, findings: Findings | None = None) -> Run:
    """A trained run, with `values` substituted for constants, learned or known, and for defaults of conditions.

    A warning about the run's version is added to `findings`.
    Raises `UserError`: GB851 to GB853 if the path is not a run, or damaged; GB804 if a name cannot be set.
    """
    from gbspec.runs import open_run as open_directory

    require_path(path, "a run is given by the path of its directory")
    return set_values(open_directory(path, findings), values)


def set_values(run: Run, values: Mapping[str, float] | None) -> Run:
    """The run with other values for constants and conditions, also in its truth. Raises `UserError` (GB804)."""
    from gbspec.passes import with_values

    if not values:
        return run
    model = frontend.verified(with_values(run.model, values), "with_values")
    return replace(run, model=model, values={**run.values, **plain_values(values)})


def specified(model: Model, values: Mapping[str, float]) -> Model:
    """The model with other values for training; its text has them too, so that the run stores the model that was used.

    A value of a learnable is its starting value; its truth is unchanged. Raises `UserError`: GB804 if a name is not a
    constant, condition or input, and any error of the model with these values.
    """
    from gbspec.passes import with_values
    from gbspec.syntax import with_settings

    if not values:
        return model
    with_values(model, values)  # raises for unknown names and values that are not finite
    source = _source(model)
    text = Source(source.path, with_settings(source, plain_values(values)))
    return frontend.load_model(text.path, Findings(), lambda _: text)


def subject(path: str | Path, values: Mapping[str, float], findings: Findings, member: int | None = None) -> Subject:
    """A MODEL at its truth or a RUN at its learned parameters, with `values` set for constants and conditions."""
    if is_run(path):
        return learned(open_run(path, findings=findings), values, member)
    return reference(frontend.load_model(path, findings), values)


@packages()
def learned(run: Run, values: Mapping[str, float] | None = None, member: int | None = None) -> Subject:
    """A run at the learned parameters of a member (default: the best one). Raises `UserError` (GB804, GB854)."""
    from gbspec.analysis import Individuals
    from gbspec.backends import Evaluator

    run = set_values(run, values)
    number = run.best if member is None else member
    own = run.member(number)
    return Subject(run.model, Evaluator(own), run, run.values, number, Individuals.of_member(own, run.model))


@packages()
def reference(model: Model, values: Mapping[str, float] | None = None, method: Method = RK4) -> Subject:
    """A model at its truth, stepped by a method.

    Raises `UserError`: GB803 for unknowns without a truth, GB804 for wrong `values`.
    """
    from gbspec.analysis import Individuals
    from gbspec.backends import Evaluator, load_module
    from gbspec.passes import with_truth, with_values

    individuals = Individuals.of_model(model, model.constant_names)
    known = frontend.verified(with_truth(model), "with_truth")
    if values:
        known = frontend.verified(with_values(known, values), "with_values")
        values = plain_values(values)
    return Subject(
        known, Evaluator(load_module(known, method)()), values=values or {}, individuals=individuals, origin=model
    )


def truth_of(source: Subject) -> Subject | None:
    """The truth of a run's model with the same values set; None if there is none."""
    from gbspec.analysis import has_reference

    if source.run is None or not has_reference(source.run.model):
        return None
    return reference(source.run.model, source.values)


# ------------------------------------------------------------------------------------------------- models to begin from
@dataclass(frozen=True)
class Bundled:
    """A bundled model: its name, the title that it gives itself, and its file."""

    name: str
    title: str
    path: Path


def bundled() -> tuple[Bundled, ...]:
    """The bundled models in the order of names."""
    from gbspec.data import shipped_models

    found = []
    for name, path in shipped_models().items():
        opening = _opening(frontend.read_source(path))
        found.append(Bundled(name, opening.title.value if opening.title else "", path))
    return tuple(found)


def copied(path: str | Path, name: str) -> tuple[str, bool]:
    """The text of a model under another name, and whether its truth is complete, so that data can be simulated with it.

    Comments are kept. The copy stands alone: the points of its tables that are in files are written into it, and so is
    what a model takes from a file that it extends; then the comments of neither file are in it. Raises `UserError` if
    the model cannot be read or has errors.
    """
    from gbspec.syntax import format_text

    source, model = frontend.read_source(path), frontend.load_model(path, Findings())
    if model.text != source.text:  # what it takes from other files stands in it
        source = Source("model.gb", format_text(_source(model)))
    span = _opening(source).name.span
    truths = {truth.name for truth in model.truth_functions}
    text = source.text[: span.start] + name + source.text[span.end :]
    return text, all(unknown.name in truths for unknown in model.unknowns)


def _opening(source: Source) -> ModelStatement:
    """The first statement of a model's text, which is known to have no errors."""
    from gbspec.syntax import ModelStatement, parse

    file = parse(source, Findings())
    first = file.statements[0] if file else None
    if not isinstance(first, ModelStatement):
        raise Defect(f"`{source.path}` has no name")
    return first


# ------------------------------------------------------------------------------------------------------------ compiling
def forms() -> dict[str, str]:
    """The forms to which a model can be compiled, each with a help line: the pipeline's stages, then the backends."""
    from gbspec.backends import backends

    stages = {stage.name: stage.help for stage in frontend.STAGES}
    return {**stages, **{backend.name: backend.help for backend in backends().values()}}


def compile_file(path: str | Path, form: str, findings: Findings, solver: str | None = None) -> Compiled:
    """A model file, or the best member of a run, in one of `forms()`. Raises `UserError` if it has errors.

    For a stage of the pipeline the later stages are not run, so that their errors are not reported. `solver` names the
    integration method (GB850 if there is none of that name); without it a run keeps its own.
    """
    from gbspec.backends import backends

    if form not in backends():
        return _stage(_model_file(path), form, findings)
    chosen = None if solver is None else method_named(solver)
    if is_run(path):
        run = open_run(path, findings=findings)
        run = run.stepped_by(chosen or run.method)
        return _emitted(learned(run) if backends()[form].numbers else run.model, form, run.method)
    model, method = frontend.load_model(path, findings), chosen or RK4
    return _emitted(reference(model, method=method) if backends()[form].numbers else model, form, method)


def _model_file(path: str | Path) -> str | Path:
    """The model file of a MODEL or a RUN."""
    if not is_run(path):
        return path
    from gbspec.runs import files

    return Path(path) / files.MODEL


def compile_model(model: Model, form: str, solver: str = "rk4") -> Compiled:
    """A Model, at its truth where numbers are needed, in one of `forms()`, with a solver's steps (else GB850)."""
    from gbspec.backends import backends

    if form not in backends():
        source = _source(model)
        return _stage(source.path, form, Findings(), lambda _: source)
    method = method_named(solver)
    return _emitted(reference(model, method=method) if backends()[form].numbers else model, form, method)


@packages()
def _emitted(source: Model | Subject, form: str, method: Method) -> Compiled:
    from gbspec.backends import backends, class_name

    model, instance = (source.model, source.evaluator.instance) if isinstance(source, Subject) else (source, None)
    return Compiled(model.name, backends()[form].emit(model, instance, method), class_name(model))


def _stage(path: str | Path, form: str, findings: Findings, read: frontend.Read | None = None) -> Compiled:
    from gbspec.syntax import ModelStatement

    state = frontend.after(form, path, findings, read)
    statements = state.file.statements if state.file else ()
    name = next((s.name.text for s in statements if isinstance(s, ModelStatement)), Path(path).stem)
    return Compiled(name, state.text, None)


def _source(model: Model) -> Source:
    """The text stored in the model, which extends no other file."""
    return Source("model.gb", model.text)
