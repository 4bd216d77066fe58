"""References and renaming of names: scopes, shadowing, files that extend one another."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gbspec import frontend
from gbspec.cli.commands.check import describe
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings, UserError
from gbspec.ir.dumping import dump
from gbspec.lsp.index import at
from gbspec.lsp.references import Refused, definitions, everywhere, rename, replaced
from gbspec.lsp.workspace import Workspace, key
from gbspec.passes.examination import examine
from gbspec.syntax import ast

MODEL = """\
model scopes
state x in [0, 2] = 1
state y in [0, 2] = 1
learn k = 1 in [0, 3]
function f(x, s) = x/(k + s)
unknown mu(u, x) >= 0, zero at u = k, increasing in u
    = f(u, x)*nn
    by mlp(4, activation=tanh)
let r = mu(y, x)
process p: x -> 2*y rate k*x
x' = net(x) - r
y' = net(y) - if(x > y and not y > 2, k, 0)
initial x = 1
observe x noise normal(0.1)
observe z = x + y
truth k = 2
truth mu(u, x) = u/(k + x)
allow GB403 z
"""


def model(tmp_path: Path, text: str = MODEL) -> tuple[Workspace, Path]:
    workspace, path = Workspace(), tmp_path / "scopes.gb"
    workspace.put(path, text)
    return workspace, path


def renamed(workspace: Workspace, path: Path, what: str, name: str, nth: int = 0) -> str:
    text = workspace.source(path).text
    offset = -1
    for _ in range(nth + 1):
        offset = text.index(what, offset + 1)
    return replaced(rename(workspace, path, offset, name).places[key(path)], name)


def test_a_running_index_is_local_to_its_statement(tmp_path: Path) -> None:
    text = (
        "model m\nconst N = 3\nstate c[1..N]\nc[i]' = -i*c[i]\ninitial c[i] = i/N\n"
        "observe c[i]\ndose c[i] times i/N lag i\n"
    )
    workspace, path = model(tmp_path, text)
    assert renamed(workspace, path, "i]' ", "j") == text.replace("c[i]' = -i*c[i]", "c[j]' = -j*c[j]")
    assert renamed(workspace, path, "i]\ndose", "j") == text.replace("observe c[i]", "observe c[j]")
    assert renamed(workspace, path, "i] times", "j") == text.replace("c[i] times i/N lag i", "c[j] times j/N lag j")


def test_a_state_is_renamed_everywhere_but_where_an_argument_shadows_it(tmp_path: Path) -> None:
    text = MODEL.replace("mu(u, x) >=", "mu(u, x in [0, 2]) >=")
    new = renamed(*model(tmp_path, text), "x in", "conv")
    assert new == text.replace("state x", "state conv").replace("mu(y, x)", "mu(y, conv)").replace(
        "p: x -> 2*y rate k*x", "p: conv -> 2*y rate k*conv"
    ).replace("x' = net(x)", "conv' = net(conv)").replace("if(x > y", "if(conv > y").replace(
        "initial x", "initial conv"
    ).replace("observe x", "observe conv").replace("z = x + y", "z = conv + y")


def test_an_argument_that_takes_the_range_of_a_state_is_renamed_with_it(tmp_path: Path) -> None:
    new = renamed(*model(tmp_path), "x in", "conv")
    assert "unknown mu(u, conv) >= 0" in new
    assert "= f(u, conv)*nn" in new
    assert "truth mu(u, x) = u/(k + x)" in new
    assert "state conv in" in renamed(*model(tmp_path), "x) >=", "conv")
    with pytest.raises(Refused, match="another meaning"):
        renamed(*model(tmp_path), "y in", "u")


def test_a_range_that_another_file_lends_is_not_lost(tmp_path: Path) -> None:
    (tmp_path / "base.gb").write_text(
        "model b\nstate x = 1\nunknown q(x) >= 0, zero at x = 0 by mlp(4)\nx' = -q(x)\nobserve x\n"
    )
    (tmp_path / "own.gb").write_text('model o extends "base.gb"\nstate x in [0, 1] = 1\n')
    with pytest.raises(Refused, match=r"in `own.gb` a contract would use the range of another quantity"):
        rename(Workspace(), tmp_path / "base.gb", 14, "y")


def test_the_parameter_of_a_function_is_renamed_only_in_it(tmp_path: Path) -> None:
    new = renamed(*model(tmp_path), "s) =", "sub")
    assert new == MODEL.replace("f(x, s) = x/(k + s)", "f(x, sub) = x/(k + sub)")


def test_the_argument_of_an_unknown_is_renamed_in_contracts_and_postulate(tmp_path: Path) -> None:
    new = renamed(*model(tmp_path), "u, x) >=", "v")
    head = "mu(u, x) >= 0, zero at u = k, increasing in u\n    = f(u, x)"
    assert new == MODEL.replace(head, head.replace("(u", "(v").replace("at u", "at v").replace("in u", "in v"))


def test_the_parameters_of_a_truth_are_local(tmp_path: Path) -> None:
    assert renamed(*model(tmp_path), "u, x) = u/(", "w") == MODEL.replace("mu(u, x) = u/(k", "mu(w, x) = w/(k")


def test_a_channel_and_a_learnable_are_renamed_with_allow_and_truth(tmp_path: Path) -> None:
    assert "allow GB403 total" in renamed(*model(tmp_path), "z = x", "total")
    assert "truth rate_k = 2" in renamed(*model(tmp_path), "k = 1", "rate_k")


def test_an_unknown_named_without_arguments_is_applied_to_their_names(tmp_path: Path) -> None:
    text = "model m\nstate x = 1\nunknown q(x) by mlp(3)\nx' = -q\nobserve x\ntruth q = 2*x\n"
    new = renamed(*model(tmp_path, text), "x = 1", "y")
    assert new == "model m\nstate y = 1\nunknown q(y) by mlp(3)\ny' = -q\nobserve y\ntruth q = 2*y\n"


def test_an_argument_that_an_unknown_takes_by_name_is_not_renamed(tmp_path: Path) -> None:
    text = "model m\nstate x = 1\nunknown q(x) by mlp(3)\nfunction f(x) = q + x\nx' = -f(x)\nobserve x\n"
    with pytest.raises(Refused, match="`q` is implicitly applied to `x`"):
        renamed(*model(tmp_path, text), "x) = q", "a")


@pytest.mark.parametrize(
    ("what", "name", "why"),
    [
        ("x in", "y", "already declared"),
        ("x in", "mu", "already declared"),
        ("x in", "observe", "begins a statement"),
        ("k = 1", "nn", "word of the language"),
        ("k = 1", "s", "another meaning"),  # a parameter of `f` would shadow it
        ("s) =", "k", "another meaning"),  # would shadow the learnable
        ("exp", "a", "word of the language"),
        ("x in", "a b", "not a name"),
        ("tanh", "relu", "word of the language"),
        ("GB403", "GB404", "word of the language"),
    ],
)
def test_refusals_say_why(tmp_path: Path, what: str, name: str, why: str) -> None:
    text = MODEL if what in MODEL else MODEL.replace("2*y rate", "2*y rate exp(1)*")
    with pytest.raises(Refused, match=why):
        renamed(*model(tmp_path, text), what, name)


def test_the_time_has_a_name_to_change_only_where_a_statement_gives_it(tmp_path: Path) -> None:
    text = "model m\nstate x = 1\nx' = -t*x\nobserve x\n"
    with pytest.raises(Refused, match="is the time"):
        renamed(*model(tmp_path, text), "t*x", "tau")
    named = text.replace("state", "time t\nstate")
    changed = named.replace("time t", "time tau").replace("-t*x", "-tau*x")
    assert renamed(*model(tmp_path, named), "t*x", "tau") == changed


def test_a_statement_that_cannot_be_read_stops_the_renaming_of_its_names(tmp_path: Path) -> None:
    workspace, path = model(tmp_path, MODEL.replace("let r = mu(y, x)", "let r = mu(y, x"))
    with pytest.raises(Refused, match="cannot be read"):
        renamed(workspace, path, "x in", "conv")
    assert "rate K" in renamed(workspace, path, "k = 1", "K")


def test_names_are_compared_after_nfkc(tmp_path: Path) -> None:
    text = "model m\nstate µ = 1\nμ' = -μ\nobserve μ\n"  # the first is the micro sign
    assert renamed(*model(tmp_path, text), "μ'", "x") == "model m\nstate x = 1\nx' = -x\nobserve x\n"


def test_units_have_a_separate_namespace(tmp_path: Path) -> None:
    text = 'model m\nunit gX "biomass"\nstate gX2 : gX/L = 1\nconst gs : gX = 2\ngX2\' = -gs*gX2/gs\nobserve gX2\n'
    new = renamed(*model(tmp_path, text), "gX/L", "gB")
    assert new == text.replace("unit gX ", "unit gB ").replace(": gX", ": gB")
    with pytest.raises(Refused, match="not declared in the model"):
        renamed(*model(tmp_path, text), "L = 1", "litre")


def test_what_a_base_declares_is_renamed_in_all_files_that_extend_it(tmp_path: Path) -> None:
    workspace = Workspace()
    (tmp_path / "base.gb").write_text("model b\nstate x = 1\nlearn k = 1 in [0, 2]\nx' = -k*x\nobserve x\n")
    (tmp_path / "one.gb").write_text('model o extends "base.gb"\nlet own = 2*k\nobserve y = own\n')
    (tmp_path / "two.gb").write_text('model t extends "one.gb"\ntruth k = 1\nlet extra = own\nwithout observe x\n')
    (tmp_path / "other.gb").write_text("model x\nstate k = 1\nk' = -k\nobserve k\n")
    start = (tmp_path / "two.gb").read_text().index("k = 1")
    places = rename(workspace, tmp_path / "two.gb", start, "kappa").places
    assert {p.name: len(spans) for p, spans in places.items()} == {"base.gb": 2, "one.gb": 1, "two.gb": 1}
    own = (tmp_path / "two.gb").read_text().index("own")
    assert {p.name for p in rename(workspace, tmp_path / "two.gb", own, "mine").places} == {"one.gb", "two.gb"}
    with pytest.raises(Refused, match="already declared"):
        rename(workspace, tmp_path / "base.gb", (tmp_path / "base.gb").read_text().index("k ="), "extra")


@pytest.mark.parametrize("word", ["ocv(soc : 1)", "soc : 1) : V from"])
def test_the_names_of_a_file_of_points_stay(word: str) -> None:
    """They are those of its columns."""
    path = shipped_models()["cell"]
    workspace = Workspace(roots=(path.parent,))
    with pytest.raises(Refused, match=r"column in the file of the table `ocv`"):
        rename(workspace, path, path.read_text().index(word), "other")


@settings(deadline=None, max_examples=25)
@given(st.data())
def test_renaming_in_a_bundled_model_keeps_the_model(data: st.DataObject) -> None:
    path = data.draw(st.sampled_from(sorted(p for p in shipped_models().values() if "extends" not in p.read_text())))
    workspace = Workspace(roots=(path.parent,))
    found = [o for o in workspace.occurrences(path) if o.symbol.space in ("name", "argument") and not o.implied]
    columns = {o.symbol for o in found if o.declares and getattr(o.statement, "file", None) is not None}
    chosen = data.draw(st.sampled_from([o for o in found if o.symbol not in columns]))
    new = data.draw(st.sampled_from(["renamed_1", "µ_x", "Ω"]))
    made = rename(workspace, path, chosen.span.start, new)
    trial = workspace.with_texts({p: replaced(spans, made.name) for p, spans in made.places.items()})
    model = frontend.load_model(path, Findings())
    after = frontend.load_model(path, Findings(), trial.source)
    assert [len(x) for x in (model.states, model.learnables, model.networks, model.channels)] == [
        len(x) for x in (after.states, after.learnables, after.networks, after.channels)
    ]
    back = at(trial.occurrences(path), made.places[key(path)][0].start)
    assert back is not None
    assert len(everywhere(trial, path, back.symbol)) == len(everywhere(workspace, path, chosen.symbol))


@pytest.mark.parametrize("path", sorted(shipped_models().values()), ids=lambda p: p.stem)
def test_a_renamed_state_leaves_the_bundled_model_as_it_was(path: Path) -> None:
    workspace = Workspace(roots=(path.parent,))
    before = described(path, workspace)
    states = {
        o.symbol.name: o
        for parsed in workspace.chain(path)
        for o in workspace.occurrences(parsed.source.path)
        if isinstance(o.statement, ast.StateStatement) and o.declares
    }
    for name, found in states.items():
        # Sorts as the old name does, so that sums are printed in the same order.
        new = next(new for new in (f"{name}0", f"{name}_") if new not in workspace.names(path).declared)
        made = rename(workspace, found.span.source.path, found.span.start, new)
        trial = workspace.with_texts({p: replaced(spans, new) for p, spans in made.places.items()})
        assert re.sub(rf"\b{new}(?![^\W_])", name, described(path, trial)) == before


def described(path: Path, workspace: Workspace) -> str:
    """The output of `check --json` for a model, and the model itself."""
    findings = Findings()
    model = frontend.load_model(path, findings, workspace.source)
    document = describe(str(path), model, findings, examine(model, findings))
    return dump(model) + json.dumps(document, ensure_ascii=False, indent=1)


@pytest.mark.parametrize("path", sorted(shipped_models().values()), ids=lambda p: p.stem)
def test_every_name_of_the_bundled_models_leads_to_its_declaration(path: Path) -> None:
    workspace = Workspace(roots=(path.parent,))
    for found in workspace.occurrences(path):
        named = found.symbol.space in ("name", "argument") and found.symbol.name != "t"
        if named and not found.implied and not found.declares:
            assert definitions(workspace, path, found.span.start), found


def test_a_cycle_of_files_is_followed_once(tmp_path: Path) -> None:
    (tmp_path / "a.gb").write_text('model a extends "b.gb"\nstate x = 1\n')
    (tmp_path / "b.gb").write_text('model b extends "a.gb"\n')
    workspace = Workspace()
    assert len(workspace.chain(tmp_path / "a.gb")) == 2
    assert len(workspace.descendants(tmp_path / "a.gb")) == 2
    with pytest.raises(UserError):
        frontend.load_model(tmp_path / "a.gb", Findings(), workspace.source)
