"""The pipeline: from the text of a model to its Model, in one place for files, runs and the editor.

    text ──ast──▶ File ──checked──▶ Checked ──lowered──▶ Model ──claims──▶ Model ──contracts──▶ Model

`STAGES` is all of it. The Model is verified after lowering and after each pass that changes it. `gbspec compile --emit`
writes down what there is after a stage. A stage imports what it needs when it runs: a model without claims or contracts
loads none of their provers, and the names of the stages cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import Defect, Findings, Source, UserError

if TYPE_CHECKING:
    from gbspec.ir import Model
    from gbspec.semantics import Checked
    from gbspec.syntax import File

Read = Callable[[str | Path], Source]
"""Gives the text of the model's file and of those that it extends: an editor has newer ones than the disk."""


@dataclass(frozen=True)
class State:
    """What there is of a model so far: each stage adds its part, a pass puts its Model in place of the one before."""

    source: Source
    read: Read
    findings: Findings
    stage: Stage | None = None
    file: File | None = None
    checked: Checked | None = None
    model: Model | None = None

    @property
    def text(self) -> str:
        """What the stage made, as text that ends with a line end."""
        return self.source.text if self.stage is None else self.stage.text(self)


@dataclass(frozen=True)
class Stage:
    """A stage, called as what there is after it, of which `help` tells; `run` makes it, `text` writes it down.

    `collects`: its errors are raised with those of the next stage, which can find more beside them.
    """

    name: str
    help: str
    run: Callable[[State], State]
    text: Callable[[State], str]
    collects: bool = False


def load_model(path: str | Path, findings: Findings, read: Read | None = None) -> Model:
    """The Model of a file, of a bundled model by name, or of what `read` gives; warnings remain in `findings`.

    Raises `UserError` with everything found if one is an error, `Defect` if a stage leaves a Model that is not well
    formed.
    """
    return _model(after(STAGES[-1].name, path, findings, read))


def after(name: str, path: str | Path, findings: Findings, read: Read | None = None) -> State:
    """What there is of a model after the stage of that name; raises as `load_model` does."""
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
    """The Model itself; raises `Defect`, naming the stage or pass that made it, where it is not well formed."""
    from gbspec.ir import verify

    try:
        verify(model)
    except Defect as problem:
        raise Defect(f"after `{name}`: {problem}") from problem
    return model


def resolve(path: str | Path) -> Path:
    """The path itself where it exists; else the bundled model of that name, if there is one; else the path."""
    from gbspec.data import shipped_models

    given = Path(path)
    return given if given.exists() else shipped_models().get(str(path), given)


def read_source(path: str | Path) -> Source:
    """The text of a model file. Raises `UserError` (GB001 to GB003) where there is none."""
    from gbspec.syntax import read_source as read

    return read(resolve(path))


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
        raise Defect("lowering comes before the checks")
    return replace(state, model=lower(state.checked, state.findings))


def _claims(model: Model, findings: Findings) -> Model:
    if model.claims:
        from gbspec.passes import check_claims

        check_claims(model, findings)
    return model


def _contracts(model: Model, findings: Findings) -> Model:
    if any(unknown.contracts for unknown in model.unknowns):
        from gbspec.passes import with_contracts

        return with_contracts(model, findings)
    return model


def model_pass(name: str, help: str, run: Callable[[Model, Findings], Model], *, collects: bool = False) -> Stage:
    """A stage that takes a Model and gives one."""
    return Stage(name, help, lambda s: replace(s, model=run(_model(s), s.findings)), _model_text, collects)


def _model(state: State) -> Model:
    if state.model is None:
        raise Defect("a Model is asked for before lowering")
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
    model_pass("claims", "after the proof of `conserve` claims", _claims, collects=True),
    model_pass("contracts", "after the proof of contracts", _contracts),
)
"""The pipeline, in its order."""
