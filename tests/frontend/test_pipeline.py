"""The pipeline: the verifier after every pass, the same stages for all readers of a model, and the results of stages.

`UPDATE_GOLDEN=1 pytest tests/frontend` rewrites the golden texts; read the difference before committing it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import gbspec
import gbspec.ir
from gbspec import frontend
from gbspec.backends.module import load_module
from gbspec.diagnostics import Defect, Findings, Severity, Source, UserError
from gbspec.ir.model import Constant, Model
from gbspec.lsp.checking import check
from gbspec.lsp.workspace import Workspace
from gbspec.operations.models import compile_file
from gbspec.runs import files
from gbspec.runs.record import DataRecord, FitRecord
from gbspec.runs.store import open_run

GOLDEN = Path(__file__).parents[1] / "golden"
ROOT = Path(gbspec.__file__).parent

BASE = """model base
time t : h from 0
state S in [0, 9] = 5
condition D : 1/h = 0.2
const Y = 2*0.25
observe S
S' = net(S) - D*S
unknown mu(S in [0, 9]) : 1/h >= 0, zero at S = 0 by mlp(8, activation=tanh) "growth"
process growth: 1/Y*S -> rate mu(S)
"""

MODEL = """model small "A small model" extends "base.gb"
state c[1..2] = 1
learn k : h^-1 = 0.3 in [0, 5] prior normal(1, 0.5)
const N = 3
c[0] = S
c[i]' = k*(c[i - 1] - c[i])/N + k*if(c[i] > 1 and S < 2, -1, 0)^2
observe y = 1 + 2 + c[2] - (3 - N) noise normal(0.05) as "signal"
truth k = 0.8
allow GB403 N
"""

CLAIM = """model claim
state A = 1
state B = 0
const k = 2
unknown f(A) >= 0 by mlp(8)
A' = -f(A)*k
B' = f(A)*k
conserve total = A + B
observe A
"""


def read(path: str | Path) -> Source:
    texts = {"small.gb": MODEL, "base.gb": BASE, "claim.gb": CLAIM}
    return Source(Path(path).name, texts[Path(path).name])


def text_of(text: str) -> frontend.Read:
    return lambda _: Source("m.gb", text)


def broken(model: Model) -> Model:
    """The Model with a constant that is declared twice, which no source can have."""
    return replace(model, constants=(*model.constants, Constant("twice", 1.0), Constant("twice", 1.0)))


def breaking(name: str) -> tuple[frontend.Stage, ...]:
    """The stages, one of which leaves a malformed Model."""

    def spoiled(run: Callable[[frontend.State], frontend.State]) -> Callable[[frontend.State], frontend.State]:
        def call(state: frontend.State) -> frontend.State:
            made = run(state)
            assert made.model is not None
            return replace(made, model=broken(made.model))

        return call

    return tuple(replace(s, run=spoiled(s.run)) if s.name == name else s for s in frontend.STAGES)


# --------------------------------------------------------------------------------------------------------- the verifier
@pytest.mark.parametrize("name", ["lowered", "claims", "contracts"])
def test_a_stage_that_breaks_the_model_is_caught_by_name(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frontend, "STAGES", breaking(name))
    with pytest.raises(Defect, match=rf"^after `{name}`: the Model is malformed: declared twice: \['twice'\]"):
        frontend.load_model("claim.gb", Findings(), read)


def test_a_new_pass_that_breaks_the_model_is_caught_too(monkeypatch: pytest.MonkeyPatch) -> None:
    added = frontend.model_pass("shorter", "", lambda model, _: replace(model, balances=model.balances[1:]))
    monkeypatch.setattr(frontend, "STAGES", (*frontend.STAGES, added))
    with pytest.raises(Defect, match="after `shorter`: the Model is malformed: one balance for each state"):
        frontend.load_model("claim.gb", Findings(), read)


def test_every_model_that_a_stage_makes_is_verified_once(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Model] = []
    monkeypatch.setattr(gbspec.ir, "verify", seen.append)
    made = frontend.load_model("claim.gb", Findings(), read)
    assert len(seen) == 2, "after lowering and after contracts; claims leave the Model as it is"
    assert seen[0].unknowns[0].form is None
    assert seen[1] is made
    assert made.unknowns[0].form is not None


# ----------------------------------------------------------------------------------------- the same stages for everyone
def run_of(folder: Path, model: Model) -> Path:
    """A run directory with one member, as written by training."""
    (folder / files.MEMBERS / "0").mkdir(parents=True)
    (folder / files.MODEL).write_text(model.text, encoding="utf-8")
    FitRecord("0", model.name, DataRecord("", "", 0, 0, 0), {}, {}, {}, {}, (), ()).write(folder)
    load_module(model).random(0).save(folder / files.MEMBERS / "0" / files.WEIGHTS)
    return folder


def test_the_model_of_a_run_goes_through_the_same_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = frontend.load_model("claim.gb", Findings(), read)
    run = run_of(tmp_path / "run", model)
    assert open_run(run).model.unknowns == model.unknowns
    for name in ("lowered", "claims", "contracts"):
        with monkeypatch.context() as patch, pytest.raises(Defect, match=f"after `{name}`"):
            patch.setattr(frontend, "STAGES", breaking(name))
            open_run(run)
    (run / files.MODEL).write_text(model.text.replace("A + B", "A - B"), encoding="utf-8")
    with pytest.raises(UserError, match="GB330"):
        open_run(run)


def test_the_editor_runs_the_same_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "claim.gb"
    path.write_text(CLAIM)
    assert not [one for one in check(Workspace(), path).findings if one.severity is Severity.ERROR]
    monkeypatch.setattr(frontend, "STAGES", breaking("contracts"))
    with pytest.raises(Defect, match="after `contracts`"):
        check(Workspace(), path)


def test_nothing_else_makes_a_model_of_a_tree() -> None:
    """Only the frontend calls the checks and lowering; the rest of the package asks it for a Model."""
    call = re.compile(r"from gbspec\.(lower import (.*, )?lower\b|semantics import (.*, )?check\b)")
    found = {
        str(path.relative_to(ROOT)) for path in ROOT.rglob("*.py") if call.search(path.read_text(encoding="utf-8"))
    }
    assert found == {"frontend.py"}


# ---------------------------------------------------------------------------------------------------------- diagnostics
def test_errors_of_the_text_and_of_its_meaning_come_together() -> None:
    with pytest.raises(UserError) as caught:
        frontend.load_model("m.gb", Findings(), text_of("model m\nstate x = = 1\nstate z = 1\nz' = -q*z\nobserve z\n"))
    assert {d.code[:3] for d in caught.value.diagnostics} == {"GB1", "GB2"}


def test_errors_of_claims_and_contracts_come_together() -> None:
    text = CLAIM.replace("A + B", "A - B").replace(">= 0", ">= 2, <= 1")
    with pytest.raises(UserError) as caught:
        frontend.load_model("m.gb", Findings(), text_of(text))
    assert {d.code for d in caught.value.diagnostics} == {"GB330", "GB603"}


def test_a_text_without_any_statement_that_can_be_read() -> None:
    with pytest.raises(UserError):
        frontend.load_model("m.gb", Findings(), text_of("?? ??\n"))


def test_an_unknown_stage() -> None:
    with pytest.raises(Defect, match="no stage `optimised`"):
        frontend.after("optimised", "claim.gb", Findings(), read)


# ------------------------------------------------------------------------------------------------- what each stage made
@pytest.mark.parametrize("name", ["ast", "checked", "lowered", "contracts"])
def test_the_result_of_a_stage(name: str) -> None:
    found = frontend.after(name, "small.gb", Findings(), read).text
    path = GOLDEN / f"small_{name}.txt"
    if os.environ.get("UPDATE_GOLDEN"):
        path.write_text(found, encoding="utf-8")
    assert found == path.read_text(encoding="utf-8")


def test_the_last_stage_makes_the_form_ir(tmp_path: Path) -> None:
    (tmp_path / "claim.gb").write_text(CLAIM)
    last = compile_file(tmp_path / "claim.gb", frontend.STAGES[-1].name, Findings()).content
    assert compile_file(tmp_path / "claim.gb", "ir", Findings()).content == last


def test_a_run_can_be_followed_through_the_stages_too(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", frontend.load_model("claim.gb", Findings(), read))
    made = compile_file(run, "ast", Findings())
    assert made.name == "claim"
    assert isinstance(made.content, str)
    assert made.content.startswith("ModelStatement 1:1\n  name claim\n")


def test_a_sum_of_thousands_of_terms_is_written() -> None:
    terms = "".join(f" {'+-'[i % 2]} x*{i}" for i in range(4000))
    found = frontend.after(
        "ast", "m.gb", Findings(), text_of(f"model m\nstate x = 1\nx' = -x{terms}\nobserve x\n")
    ).text
    assert found.count("(* x ") == 4000
    assert found.endswith("ObserveStatement 4:1\n  target x\n")
