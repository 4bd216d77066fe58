"""A real client and `gbspec lsp` over the protocol."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from lsprotocol import types
from pygls.exceptions import JsonRpcException

from gbspec import frontend
from gbspec.diagnostics import Findings
from tests.lsp.editor import Editor, place

BASE = """\
model base "A base"
state X in [0, 2] = 1 "biomass"
const D = 0.3 "dilution rate"
unknown mu(X) by mlp(4)
X' = mu*X - D*X
observe X
state S in [0, 2] = 1
S' = -D*S
observe S
"""
DERIVED = """\
model derived extends "base.gb"
learn D = 0.2 in [0, 1]
"""


def document(uri: str) -> types.TextDocumentIdentifier:
    return types.TextDocumentIdentifier(uri)


def applied(text: str, edits: list[types.TextEdit]) -> str:
    """The text with the edits of a reply (BMP texts, so that columns count characters)."""
    lines = text.split("\n")
    starts = [sum(len(line) + 1 for line in lines[:i]) for i in range(len(lines) + 1)]
    for edit in sorted(edits, key=lambda e: (-e.range.start.line, -e.range.start.character)):
        start = starts[edit.range.start.line] + edit.range.start.character
        end = starts[edit.range.end.line] + edit.range.end.character
        text = text[:start] + edit.new_text + text[end:]
    return text


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    base, derived = tmp_path / "base.gb", tmp_path / "derived.gb"
    base.write_text(BASE)
    derived.write_text(DERIVED)
    return base, derived


def test_diagnostics_come_with_code_range_and_help_and_go_when_corrected(editor: Editor, tmp_path: Path) -> None:
    wrong = BASE.replace("D*X", "DD*X")
    uri = editor.open(tmp_path / "base.gb", wrong)
    found = editor.findings(uri)
    assert {str(d.code) for d in found} == {"GB201"}
    assert found[0].severity == types.DiagnosticSeverity.Error
    assert (found[0].range.start, found[0].range.end) == (place(wrong, "DD*X"), place(wrong, "DD*X", 2))
    assert "did you mean `D`" in found[0].message
    editor.change(uri, BASE)
    assert editor.findings(uri) == []


def test_a_quick_fix_puts_the_name_that_was_meant(editor: Editor, tmp_path: Path) -> None:
    wrong = BASE.replace("D*X", "DD*X")
    uri = editor.open(tmp_path / "base.gb", wrong)
    found = editor.findings(uri)
    asked = types.CodeActionParams(document(uri), found[0].range, types.CodeActionContext(found))
    actions = editor.ask(editor.client.text_document_code_action_async, asked)
    assert [a.title for a in actions] == ["Replace `DD` by `D`"]
    assert applied(wrong, actions[0].edit.changes[uri]) == BASE


def test_a_warning_can_be_accepted_by_a_quick_fix(editor: Editor, tmp_path: Path) -> None:
    text = BASE + "const unused = 3\n"
    uri = editor.open(tmp_path / "base.gb", text)
    found = editor.findings(uri)
    assert [str(d.code) for d in found] == ["GB403"]
    asked = types.CodeActionParams(document(uri), found[0].range, types.CodeActionContext(found))
    actions = editor.ask(editor.client.text_document_code_action_async, asked)
    mended = applied(text, actions[-1].edit.changes[uri])
    assert mended.endswith("allow GB403 unused\n")
    editor.change(uri, mended)
    assert editor.findings(uri) == []


def test_an_unsaved_base_counts_for_the_files_that_extend_it(editor: Editor, files: tuple[Path, Path]) -> None:
    base, derived = files
    one, two = editor.open(base), editor.open(derived)
    assert editor.findings(one) == []
    assert editor.findings(two) == []
    editor.published.pop(two)
    editor.change(one, BASE.replace("- D*X", "- D*X + Q"))
    found = editor.findings(two)
    assert [str(d.code) for d in found] == ["GB201"]
    assert found[0].range.start == place(DERIVED, '"base.gb"')
    assert found[0].message.startswith("in `base.gb`:")
    related = found[0].related_information
    assert related is not None
    assert Path(related[0].location.uri).name == "base.gb"
    assert related[0].location.range.start.line == 4


def test_hover_tells_role_description_range_and_value(editor: Editor, files: tuple[Path, Path]) -> None:
    base, derived = files
    one, two = editor.open(base), editor.open(derived)
    editor.findings(one)

    def hovered(uri: str, position: types.Position) -> str:
        reply = editor.ask(editor.client.text_document_hover_async, types.HoverParams(document(uri), position))
        return str(reply.contents.value) if reply is not None else ""

    state = hovered(one, place(BASE, "X in"))
    assert "state" in state
    assert "biomass" in state
    assert "0 to 2" in state
    assert "X' = mu*X - D*X" in state
    assert "value: 0.3" in hovered(one, place(BASE, "D = 0.3"))
    assert "learnable constant" in hovered(two, place(DERIVED, "D = 0.2"))
    assert "column of the data" in hovered(one, place(BASE, "observe"))
    assert "multilayer perceptron" in hovered(one, place(BASE, "mlp"))
    assert hovered(one, place(BASE, "A base")) == ""


def completed(editor: Editor, uri: str, position: types.Position) -> set[str]:
    params = types.CompletionParams(document(uri), position)
    return {item.label for item in editor.ask(editor.client.text_document_completion_async, params).items}


def test_completion_knows_statements_clauses_names_and_words(editor: Editor, files: tuple[Path, Path]) -> None:
    base, _ = files
    uri = editor.open(base)

    def at_the_end(line: str) -> set[str]:
        editor.change(uri, BASE + line)
        return completed(editor, uri, types.Position(BASE.count("\n"), len(line)))

    assert {"state", "learn", "observe"} <= at_the_end("")
    assert {"prior", "per"} <= at_the_end("learn k = 1 ")
    assert "rate" not in at_the_end("learn k = 1 ")
    assert {"X", "D", "mu", "exp", "if"} <= at_the_end("let r = 2*")
    assert "nn" not in at_the_end("let r = 2*")
    assert {"u", "v", "nn"} <= at_the_end("unknown q(u, v) = u*")
    assert {"silu", "tanh"} <= at_the_end("unknown q(u) by mlp(3, activation=")
    assert {"normal", "lognormal"} == at_the_end("learn k = 1 prior ")
    noises = {"normal", "lognormal", "student", "poisson", "negative_binomial"}
    assert noises == at_the_end("observe y = X noise ")
    assert {"L", "h"} <= at_the_end("state S : ")
    assert at_the_end('state S "') == set()


def test_completion_replaces_the_word_that_is_being_written(editor: Editor, files: tuple[Path, Path]) -> None:
    text = BASE + "let r = 2*ex"
    uri = editor.open(files[0], text)
    params = types.CompletionParams(document(uri), place(text, "2*ex", 4))
    items = editor.ask(editor.client.text_document_completion_async, params).items
    edit = next(item.text_edit for item in items if item.label == "exp")
    assert (edit.range.start.character, edit.range.end.character) == (10, 12)


def test_definitions_lead_through_the_files_that_are_extended(editor: Editor, files: tuple[Path, Path]) -> None:
    _, derived = files
    text = DERIVED + "let twice = 2*X + D\n"
    uri = editor.open(derived, text)

    def defined(what: str, after: int = 0) -> list[tuple[str, int, int]]:
        params = types.DefinitionParams(document(uri), place(text, what, after))
        found = editor.ask(editor.client.text_document_definition_async, params)
        return [(Path(f.uri).name, f.range.start.line, f.range.start.character) for f in found]

    assert defined("*X + D", 1) == [("base.gb", 1, 6)]
    assert defined("+ D", 2) == [("derived.gb", 1, 6)]
    assert defined("D = 0.2") == [("base.gb", 2, 6)]  # what this declaration replaces
    assert defined('"base.gb"', 2) == [("base.gb", 0, 0)]


def test_references_are_found_in_every_file_of_the_model(editor: Editor, files: tuple[Path, Path]) -> None:
    base, _ = files
    uri = editor.open(base)
    params = types.ReferenceParams(types.ReferenceContext(True), document(uri), place(BASE, "D = 0.3"))
    found = editor.ask(editor.client.text_document_references_async, params)
    assert sorted((Path(f.uri).name, f.range.start.line) for f in found) == [
        ("base.gb", 2),
        ("base.gb", 4),
        ("base.gb", 7),
        ("derived.gb", 1),
    ]


def test_a_renamed_model_is_still_right(editor: Editor, files: tuple[Path, Path]) -> None:
    base, derived = files
    uri = editor.open(base)
    params = types.RenameParams(document(uri), place(BASE, "X in"), "cells")
    edit = editor.ask(editor.client.text_document_rename_async, params)
    base.write_text(applied(BASE, edit.changes[uri]))
    assert "unknown mu(cells)" in base.read_text()  # `mu` stands without arguments and takes them by name
    assert "cells' = mu*cells - D*cells" in base.read_text()
    for path in (base, derived):
        findings = Findings()
        assert [s.name for s in frontend.load_model(path, findings).states] == ["cells", "S"]
        assert list(findings) == []


@pytest.mark.parametrize("name", ["D", "exp", "2x", "state", "t", ""])
def test_a_name_that_cannot_be_is_refused_with_the_reason(editor: Editor, files: tuple[Path, Path], name: str) -> None:
    uri = editor.open(files[0])
    params = types.RenameParams(document(uri), place(BASE, "X in"), name)
    with pytest.raises(JsonRpcException, match=r"`.*`"):
        editor.ask(editor.client.text_document_rename_async, params)


def test_formatting_changes_the_lines_that_are_out_of_form(editor: Editor, files: tuple[Path, Path]) -> None:
    loose = BASE.replace("const D = 0.3", "const   D=0.3")
    uri = editor.open(files[0], loose)
    params = types.DocumentFormattingParams(document(uri), types.FormattingOptions(4, True))
    edits = editor.ask(editor.client.text_document_formatting_async, params)
    assert applied(loose, edits) == BASE
    assert [e.range.start.line for e in edits] == [2]
    editor.change(uri, loose.replace("X' =", "X' = = "))
    assert not editor.ask(editor.client.text_document_formatting_async, params)


def test_a_broken_file_still_has_an_outline(editor: Editor, files: tuple[Path, Path]) -> None:
    uri = editor.open(files[0], BASE.replace("const D = 0.3", "const D = = 0.3"))
    params = types.DocumentSymbolParams(document(uri))
    groups = editor.ask(editor.client.text_document_document_symbol_async, params)
    names = {g.name: [c.name for c in g.children] for g in groups}
    assert names["states"] == ["X", "S"]
    assert names["balances"] == ["X'", "S'"]
    assert names["unknown functions"] == ["mu"]
    assert "constants" not in names


@pytest.mark.parametrize("text", ["", "\ufeff", "\r\n\r\n", '"', "x[", "unknown (((", "𝒙' = 𝒙 +\t", "#" * 50, "\0"])
def test_no_text_and_no_place_ends_the_session(editor: Editor, tmp_path: Path, text: str) -> None:
    uri = editor.open(tmp_path / "odd.gb", text)
    for position in (types.Position(0, 0), types.Position(0, 3), types.Position(99, 99)):
        editor.ask(editor.client.text_document_hover_async, types.HoverParams(document(uri), position))
        editor.ask(editor.client.text_document_definition_async, types.DefinitionParams(document(uri), position))
        completed(editor, uri, position)
    editor.ask(editor.client.text_document_document_symbol_async, types.DocumentSymbolParams(document(uri)))
    assert isinstance(editor.findings(uri), list)


def test_a_file_that_is_not_there_is_answered_with_nothing(editor: Editor, tmp_path: Path) -> None:
    params = types.HoverParams(document((tmp_path / "absent.gb").as_uri()), types.Position(0, 0))
    assert editor.ask(editor.client.text_document_hover_async, params) is None


def test_a_text_that_is_in_no_file_yet_is_checked_too(editor: Editor) -> None:
    uri = "untitled:Untitled-1"
    item = types.TextDocumentItem(uri, "gb", 1, BASE.replace("D*X", "DD*X"))
    editor.versions[uri] = 1
    editor.send(editor.client.text_document_did_open, types.DidOpenTextDocumentParams(item))
    assert editor.codes(uri) == ["GB201"]


def test_a_burst_of_changes_ends_with_the_diagnostics_of_the_last(editor: Editor, tmp_path: Path) -> None:
    uri = editor.open(tmp_path / "base.gb", BASE)
    assert editor.codes(uri) == []
    for end in range(1, 9):
        editor.change(uri, BASE + "let r = 2*XX"[:end] + "\n")
    editor.change(uri, BASE + "let r = 2*XX\n")
    assert editor.codes(uri) == ["GB201"]


def test_a_closed_file_has_no_diagnostics(editor: Editor, tmp_path: Path) -> None:
    uri = editor.open(tmp_path / "base.gb", "model m\nx' = y\n")
    assert editor.findings(uri)
    editor.published.pop(uri)
    editor.send(editor.client.text_document_did_close, types.DidCloseTextDocumentParams(document(uri)))
    assert editor.findings(uri) == []


def test_columns_are_counted_as_the_editor_asks(tmp_path: Path) -> None:
    made = Editor()
    result: Any = made.start(["utf-8", "utf-16"])
    assert result.capabilities.position_encoding == "utf-8"
    uri = made.open(tmp_path / "odd.gb", "model m\r\nstate μ = 1\r\nμ' = 𝒙*μ - μμ\r\n")
    found = [d for d in made.findings(uri) if "μμ" in d.message]
    assert [(d.range.start.line, d.range.start.character) for d in found] == [(2, 16)]
    assert made.stop() == 0


def test_columns_count_utf_16_where_nothing_else_is_agreed(editor: Editor, tmp_path: Path) -> None:
    uri = editor.open(tmp_path / "odd.gb", "model m\r\nstate μ = 1\r\nμ' = 𝒙*μ - μμ\r\n")
    found = [d for d in editor.findings(uri) if "μμ" in d.message]
    assert [(d.range.start.line, d.range.start.character) for d in found] == [(2, 12)]
