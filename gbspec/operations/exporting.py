"""Exports of models and runs for other programs: C, FMUs, ONNX."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gbspec.diagnostics import ComputationError, Diagnostic, Findings, UserError, packages
from gbspec.operations import evaluating, exchanging, tables
from gbspec.operations.models import Subject

if TYPE_CHECKING:
    from gbspec.data import SimulateOptions, Trajectories
    from gbspec.exports import Example, Exported, ExportOptions, Form, Layout, Precision
    from gbspec.ir import Range

ExportForm = Literal["c", "fmu", "fmu2", "fmu3", "onnx", "petab", "sbml"]
"""The forms, for type checkers; a test compares them with those that there are."""
SPAN, INTERVAL = 10.0, 0.5
"""The duration of the trajectory that an exported program simulates, and the interval of its outputs."""


@dataclass(frozen=True)
class Export:
    """What was written: path, form, the model's name and fingerprint, the names of the files, the number of bytes,
    the largest error of each quantity that was compared with the generated module, relative to its terms, and remarks
    in words."""

    path: str
    form: str
    model: str
    fingerprint: str
    files: tuple[str, ...]
    size: int
    checked: dict[str, float]
    remarks: tuple[str, ...] = ()


def forms() -> dict[str, str]:
    """The forms of an export, each with a help line."""
    from gbspec.exports import FORMS

    return {name: form.help for name, form in FORMS.items()}


@packages()
def export(
    source: Subject, path: str | Path, form: str, options: ExportOptions, findings: Findings, name: str = ""
) -> Export:
    """Writes a subject in one of `forms()`; `name` is what the user calls it.

    Raises `UserError` (GB808 for what the form cannot express, GB880 for a folder of other files), `ComputationError`
    if the export differs from the generated module.
    """
    from gbspec.backends import NotCoveredError
    from gbspec.exports import FORMS, Exported, check, layout, plain, write

    chosen = FORMS[form]
    written = layout(path, chosen.packed, chosen.single)
    check(path, written)
    options = _suited(options, form, chosen, written)
    if chosen.tabled and source.individuals is not None:
        reason = "its constants are distributed between trajectories (`~`)"
        raise UserError([_refused(form, source.model.name, reason)])
    if options.data is not None:
        options = replace(options, starts=evaluating.starts_of(source, options.data))
        source = _with_noise(source)
    if chosen.name in exchanging.FORMS and source.origin is not None:  # what is learned stays so
        source = replace(source, model=evaluating.known(source.origin, source.values))
    number = source.member
    step = None if source.run is None or number is None else source.run.step(number)
    subject = Exported(source.model, source.evaluator.instance, name or source.model.name, source.values, step)
    if not source.model.states:
        raise UserError([_refused(form, source.model.name, "it has no states")])
    try:
        shown = example(source, subject) if chosen.simulates else plain(subject)
        made = chosen.make(subject, shown, options)
    except NotCoveredError as problem:
        raise UserError([_refused(form, source.model.name, str(problem))]) from None
    if options.verify and form in exchanging.FORMS:
        made = exchanging.checked(source, subject, form, made, options)
    findings.extend(made.remarks)
    size = write(path, made.files, written)
    checked = {quantity.name: quantity.error for quantity in made.checked}
    remarks = tuple(remark.message for remark in made.remarks)
    return Export(str(path), form, source.model.name, subject.fingerprint, tuple(made.files), size, checked, remarks)


def exported(
    source: Subject,
    path: str | Path,
    form: str,
    name: str,
    *,
    verify: bool = True,
    precision: Precision = "float64",
    part: str | None = None,
    data: Trajectories | None = None,
) -> Export:
    """`export` with its options as arguments. Raises ValueError if there is no such form."""
    from gbspec.exports import ExportOptions

    if form not in forms():
        raise ValueError(f"there is no form `{form}`; there are {', '.join(forms())}")
    return export(source, path, form, ExportOptions(verify, precision, part, data), Findings(), name)


def _with_noise(source: Subject) -> Subject:
    """A run with the noises that its fit found, for the channels that state none."""
    from gbspec.ir import Noise

    if source.run is None:
        return source
    found = {name: sd for name, sd in source.run.fit.noise.items() if sd}
    channels = tuple(
        replace(c, noise=Noise("normal", found[c.name])) if c.noise is None and c.name in found else c
        for c in source.model.channels
    )
    return replace(source, model=replace(source.model, channels=channels))


def _suited(options: ExportOptions, form: str, chosen: Form, written: Layout) -> ExportOptions:
    """The options for a path of one file: its part. Raises `UserError` (GB881) for an option that a form has not."""
    if chosen.tabled and options.data is None:
        message = f"the form `{form}` needs a table of measurements"
        raise UserError([Diagnostic("GB891", message, None, help="name one: `--data table.csv`")])
    if form != "onnx" and (options.part is not None or options.precision != "float64"):
        given = "part" if options.part is not None else "precision"
        message = f"the form `{form}` has no option `{given}`"
        raise UserError([Diagnostic("GB881", message, None, help="`--part` and `--precision` are of `--as onnx`")])
    return replace(options, part="rhs") if form == "onnx" and written == "file" and options.part is None else options


def _refused(form: str, model: str, reason: str) -> Diagnostic:
    message = f"the form `{form}` cannot express the model `{model}`: {reason}"
    return Diagnostic("GB808", message, None, help="`gbspec compile --emit module` expresses every model")


def example(source: Subject, exported: Exported) -> Example:
    """One trajectory of `gbspec simulate`, a shorter one if that fails, or from the initial values."""
    from gbspec.analysis import true_starts
    from gbspec.data import fixed
    from gbspec.exports import Example, plain

    for share in (1.0, 0.5, 0.25):
        options = _options(source, exported, share * SPAN)
        try:
            held = fixed(options, source.values, source.model)
            starts = true_starts(source.evaluator, source.model, held)
            (item,) = tables.simulate(source, options).items
        except (ComputationError, UserError):
            continue
        command = _command(exported, options)
        return Example(starts[0], item.start, item.times, item.condition, item.inputs, item.doses, command)
    return plain(exported)


def _options(source: Subject, exported: Exported, span: float = SPAN) -> SimulateOptions:
    """The options of the trajectory: values for everything that has no range, and a dose of 1 into each dosed state."""
    from gbspec.data import SimulateOptions

    model = source.model
    initial = {
        state.name: (float(value), float(value))
        for state, value in zip(model.states, exported.states, strict=True)
        if not state.initial.known and state.start is None and not _bounded(state.range)
    }
    external: dict[str, tuple[float, float]] = {}
    for name, value, default, range in (
        *((c.name, v, c.default, c.range) for c, v in zip(model.conditions, exported.conditions, strict=True)),
        *((i.name, v, i.default, i.range) for i, v in zip(model.inputs, exported.inputs, strict=True)),
    ):
        if default is None and not _bounded(range):
            external[name] = (float(value), float(value))
    doses = {dose.state: f"1@{exported.start:g}" for dose in model.doses}
    return SimulateOptions(1, span, INTERVAL, initial=initial, condition=external, dose=doses)


def _bounded(range: Range | None) -> bool:
    return range is not None and range.bounded


def _command(exported: Exported, options: SimulateOptions) -> str:
    """The command that simulates the same trajectory."""
    parts = ["gbspec", "simulate", exported.source, "-o", "table.csv", "--trajectories", "1"]
    parts += ["--span", f"{options.span:g}"] if options.span != SPAN else []
    for flag, boxes in (("--initial", options.initial), ("--condition", options.condition)):
        for name, (low, _) in boxes.items():
            parts += [flag, f"{name}={low!r}"]
    for name, text in options.dose.items():
        parts += ["--dose", f"{name}={text}"]
    for name, value in exported.values.items():
        parts += ["--set", f"{name}={value!r}"] if math.isfinite(value) else []
    return shlex.join(parts)
