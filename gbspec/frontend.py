"""The pipeline from the text of a model to its Model, shared by commands, runs and the editor.

    text ──ast──▶ File ──checked──▶ Checked ──lowered──▶ Model, ──structure──▶, ──claims──▶ and ──contracts──▶ Model

`STAGES` has all its stages. The Model is verified after lowering and after each pass that changes it. `gbspec compile
--emit` writes the result of a stage. A stage imports its modules when it runs: a model without claims or contracts
imports none of their provers, and listing the stages imports nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import Defect, Diagnostic, Findings, Source, UserError
from gbspec.given import require_path

if TYPE_CHECKING:
    from gbspec.ir import Model
    from gbspec.semantics import Checked
    from gbspec.syntax import File

Read = Callable[[str | Path], Source]
"""Reads the text of the model's file and of those that it extends; an editor may have newer texts than the disk."""


@dataclass(frozen=True)
class State:
    """The intermediate results for a model: each stage adds its own, and a pass replaces the Model."""

    source: Source
    read: Read
    findings: Findings
    stage: Stage | None = None
    file: File | None = None
    checked: Checked | None = None
    model: Model | None = None

    @property
    def text(self) -> str:
        """The result of the stage as text, which ends with a line end."""
        return self.source.text if self.stage is None else self.stage.text(self)


@dataclass(frozen=True)
class Stage:
    """A stage, named after its result, which `help` describes; `run` computes the result, `text` renders it.

    `collects`: its errors are raised together with those of the next stage, which can run in spite of them.
    """

    name: str
    help: str
    run: Callable[[State], State]
    text: Callable[[State], str]
    collects: bool = False


def load_model(path: str | Path, findings: Findings, read: Read | None = None) -> Model:
    """The Model of a file, of a bundled model by name, or of the texts from `read`; warnings remain in `findings`.

    Raises `UserError` with all diagnostics if one is an error, `Defect` if a stage leaves a malformed Model.
    """
    return _model(after(STAGES[-1].name, path, findings, read))


def after(name: str, path: str | Path, findings: Findings, read: Read | None = None) -> State:
    """The results for a model up to the named stage; raises like `load_model`."""
    read = read or read_source
    state = State(read(path), read, findings)
    for stage in STAGES:
        before, state = state.model, replace(stage.run(state), stage=stage)
        if stage.name == name or not stage.collects:
            findings.raise_if_failed()
        if state.model is not None and state.model is not before:
            verified(state.model, stage.name)
        if stage.name == name:
            return state
    raise Defect(f"the pipeline has no stage `{name}`")


def verified(model: Model, name: str) -> Model:
    """The given Model; raises `Defect`, with the name of the stage or pass, if it is malformed."""
    from gbspec.ir import verify

    try:
        verify(model)
    except Defect as problem:
        raise Defect(f"after `{name}`: {problem}") from problem
    return model


def resolve(path: str | Path) -> Path:
    """The path if it exists; else that of the bundled model with this name, if there is one; else the path.

    Raises TypeError for what is no path.
    """
    from gbspec.data import shipped_models

    require_path(path, "a model is given by its path, or a bundled one by its name")
    given = Path(path)
    return given if given.exists() else shipped_models().get(str(path), given)


def read_source(path: str | Path) -> Source:
    """The text of a model file. Raises `UserError` (GB001 to GB003) if it cannot be read."""
    from gbspec.syntax import read_source as read

    try:
        return read(resolve(path))
    except UserError as error:
        raise UserError([_suggesting(path, found) for found in error.diagnostics]) from None


def _suggesting(path: str | Path, found: Diagnostic) -> Diagnostic:
    """The diagnostic with the bundled model of a similar name, where no file was found and none nearby is similar."""
    from gbspec.data import shipped_models, similar

    given = Path(path)
    if found.code != "GB001" or found.help or given.parent != Path():
        return found
    meant = similar(given.stem, shipped_models())
    if meant is not None:
        return replace(found, help=f"did you mean the bundled model `{meant}`?")
    return replace(found, help="name a `.gb` file, or a bundled model (`gbspec models` lists them)")


# --------------------------------------------------------------------------------------------------------- the stages
def _parse(state: State) -> State:
    from gbspec.syntax import parse

    return replace(state, file=parse(state.source, state.findings))


def _check(state: State) -> State:
    from gbspec.semantics import check

    checked = None if state.file is None else check(state.file, state.findings, state.read)
    if checked is None:
        raise UserError(state.findings)
    return replace(state, checked=checked)


def _lower(state: State) -> State:
    from gbspec.lower import lower

    if state.checked is None:
        raise Defect("lowering ran before the checks")
    return replace(state, model=lower(state.checked, state.findings))


def _structure(model: Model, findings: Findings) -> Model:
    if model.algebraics or model.constraints:
        from gbspec.passes import with_structure

        return with_structure(model, findings)
    return model


def _claims(model: Model, findings: Findings) -> Model:
    if model.claims:
        from gbspec.passes import check_claims

        check_claims(model, findings)
    return model


def _contracts(model: Model, findings: Findings) -> Model:
    if any(unknown.contracts for unknown in model.unknowns) or any(network.spline for network in model.networks):
        from gbspec.passes import with_contracts

        return with_contracts(model, findings)
    return model


def _steady(model: Model, findings: Findings) -> Model:
    if model.steady is not None:
        from gbspec.passes import with_steady_start

        return with_steady_start(model, findings)
    return model


def model_pass(name: str, help: str, run: Callable[[Model, Findings], Model], *, collects: bool = False) -> Stage:
    """A stage that transforms a Model."""
    return Stage(name, help, lambda s: replace(s, model=run(_model(s), s.findings)), _model_text, collects)


def _model(state: State) -> Model:
    if state.model is None:
        raise Defect("a Model was requested before lowering")
    return state.model


def _file_text(state: State) -> str:
    from gbspec.syntax import dump

    return "" if state.file is None else dump(state.file)


def _checked_text(state: State) -> str:
    from gbspec.semantics import dump

    return "" if state.checked is None else dump(state.checked)


def _model_text(state: State) -> str:
    from gbspec.ir import dump

    return dump(_model(state))


STAGES: tuple[Stage, ...] = (
    Stage("ast", "the syntax tree", _parse, _file_text, collects=True),
    Stage("checked", "names, constants and statements after the checks", _check, _checked_text),
    Stage("lowered", "the Model before any pass", _lower, _model_text),
    model_pass("structure", "after algebraic equations were put in the order of their solution", _structure),
    model_pass("claims", "after the proof of `conserve` claims", _claims, collects=True),
    model_pass("contracts", "after the proof of contracts", _contracts, collects=True),
    model_pass("steady", "after the laws of a steady start", _steady),
)
"""The stages of the pipeline, in their order."""
