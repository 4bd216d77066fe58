"""What an editor shows while a file is read and written: tokens by meaning, signatures, links, refusals."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import pytest
from lsprotocol import types

from gbspec.diagnostics import entries
from gbspec.lsp.explained import Explanations, markdown
from gbspec.lsp.semantic import MODIFIERS, TYPES, tokens
from gbspec.lsp.signatures import signature
from gbspec.lsp.workspace import Workspace
from gbspec.syntax import Kind
from tests.lsp.editor import Editor, place

TEXT = """\
model reactor "A reactor"
unit cells = 1
time t : h
condition T in [280, 320] : K
input F : 1/h
state X in [0, 2] = 1 "biomass"
const D = 0.3
learn k = 1 in [0, 5] prior lognormal(1, 0.2)
function half(s, K) = s/(K + s)
unknown mu(X, T) by mlp(4, activation=tanh) "growth"
let rate = half(X, 2)*max(X, pi)
X' = mu(X, T)*k - D*X + F*rate + nowhere
observe X noise normal(0.1)
"""


def document(uri: str) -> types.TextDocumentIdentifier:
    return types.TextDocumentIdentifier(uri)


def workspace(folder: Path, text: str = TEXT) -> tuple[Workspace, Path]:
    made, path = Workspace(), folder / "reactor.gb"
    made.put(path, text)
    return made, path


def test_every_name_has_the_token_of_what_it_is(tmp_path: Path) -> None:
    found = {(t.span.text, t.type, t.modifiers) for t in tokens(*workspace(tmp_path))}
    for expected in (
        ("reactor", "class", ("declaration",)),
        ("t", "property", ("declaration", "readonly", "given")),
        ("T", "property", ("readonly", "given")),
        ("F", "property", ("readonly", "given")),
        ("X", "variable", ()),
        ("D", "variable", ("declaration", "readonly")),
        ("k", "variable", ("readonly", "learned")),
        ("mu", "function", ("declaration", "learned")),
        ("mu", "function", ("learned",)),
        ("half", "function", ()),
        ("s", "parameter", ("declaration",)),
        ("K", "parameter", ()),
        ("max", "function", ("defaultLibrary",)),
        ("pi", "variable", ("readonly", "defaultLibrary")),
        ("mlp", "type", ("defaultLibrary",)),
        ("activation", "property", ("defaultLibrary",)),
        ("tanh", "enumMember", ("defaultLibrary",)),
        ("lognormal", "type", ("defaultLibrary",)),
        ("h", "type", ()),
    ):
        assert expected in found, expected
    assert not any(text == "nowhere" for text, _, _ in found), "nothing declares it"
    assert {kind for _, kind, _ in found} <= set(TYPES)
    assert {one for _, _, modifiers in found for one in modifiers} <= set(MODIFIERS)


def test_names_of_an_extended_file_have_their_tokens(tmp_path: Path) -> None:
    made, _ = workspace(tmp_path)
    path = tmp_path / "other.gb"
    made.put(path, 'model other extends "reactor.gb"\nlearn D = 1\nX\' = mu(X, T)*D\n')
    found = {(t.span.text, t.type, t.modifiers) for t in tokens(made, path)}
    assert ("D", "variable", ("readonly", "learned")) in found  # no longer the constant of the base
    assert ("mu", "function", ("learned",)) in found


def test_every_kind_of_name_has_a_token() -> None:
    from gbspec.lsp import semantic

    assert semantic._NAMES.keys() == set(Kind)


def test_an_editor_gets_the_tokens_where_they_are(editor: Editor, tmp_path: Path) -> None:
    text = TEXT.replace("biomass", "𝒙, biomass")
    uri = editor.open(tmp_path / "reactor.gb", text)
    data = editor.ask(editor.client.text_document_semantic_tokens_full_async,
                      types.SemanticTokensParams(document(uri))).data  # fmt: skip
    lines, line, column, seen = text.split("\n"), 0, 0, []
    for down, right, length, kind, _ in zip(*(data[i::5] for i in range(5)), strict=True):
        line, column = line + down, right if down else column + right
        written = lines[line].encode("utf-16-le")[2 * column : 2 * (column + length)].decode("utf-16-le")
        seen.append((written, TYPES[kind]))
    assert seen == [(t.span.text, t.type) for t in tokens(*workspace(tmp_path, text))]
    assert ("mu", "function") in seen


@pytest.mark.parametrize(
    ("text", "label", "active"),
    [
        ("X' = mu(|", "mu(X, T)", 0),
        ("X' = mu(X, |", "mu(X, T)", 1),
        ("X' = D*half(max(1, 2), |", "half(s, K)", 1),
        ("X' = half(max(1, |", "max(a, b, …)", 1),
        ("X' = max(1, 2, 3, 4, |", "max(a, b, …)", 2),
        ("X' = if(X > 1, |", "if(condition, a, b)", 1),
        ("learn q = 1 prior lognormal(1, |", "lognormal(median, cv)", 1),
        ("observe X noise lognormal(|", "lognormal(cv)", 0),
        ("unknown f(X) by mlp(4, |", "mlp(width, …, activation=silu)", 1),
        ("X' = (|", None, 0),
        ("X' = mu(X, T) + |", None, 0),
        ("X' = nothing(|", None, 0),
        ("X' = X(|", None, 0),
        ("unknown g(X, |", None, 0),
        ("function g(|", None, 0),
        ('const c = 1 "mu(|', None, 0),
        ("# mu(|", None, 0),
        ("learn q = 1 in [0, |", None, 0),
    ],
)
def test_the_call_around_the_cursor_has_its_signature(
    tmp_path: Path, text: str, label: str | None, active: int
) -> None:
    whole = TEXT + text.replace("|", "")
    found = signature(*workspace(tmp_path, whole), len(TEXT) + text.index("|"))
    if label is None:
        assert found is None
        return
    assert found is not None
    assert (found.label, found.active) == (label, active)
    names = [found.label[start:end] for start, end in found.parameters]
    assert names == label[label.index("(") + 1 : -1].split(", ")
    assert found.documentation


def test_an_editor_gets_the_signature(editor: Editor, tmp_path: Path) -> None:
    text = TEXT + "let more = mu(X, "
    uri = editor.open(tmp_path / "reactor.gb", text)
    at = place(text, "let more = mu(X, ", len("let more = mu(X, "))
    found = editor.ask(editor.client.text_document_signature_help_async, types.SignatureHelpParams(document(uri), at))
    (one,) = found.signatures
    assert (one.label, found.active_parameter) == ("mu(X, T)", 1)
    assert [one.label[slice(*p.label)] for p in one.parameters] == ["X", "T"]
    assert "growth" in one.documentation.value


def test_a_code_links_to_its_explanation(editor: Editor, tmp_path: Path) -> None:
    uri = editor.open(tmp_path / "reactor.gb", TEXT)
    (found,) = (d for d in editor.findings(uri) if d.code == "GB201")
    assert found.code_description is not None
    path = Path(url2pathname(urlparse(found.code_description.href).path))
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# GB201: a name that nothing declares\n")
    assert "## Right" in text
    assert path.parent.stat().st_mode & 0o077 == 0, "nobody else may write it"


def test_every_code_has_an_explanation_to_link_to() -> None:
    for code in entries():
        assert markdown(code).startswith(f"# {code}: ")


def test_a_code_without_an_explanation_has_no_link(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert Explanations().link("GB000") is None
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "absent"))
    assert Explanations().link("GB201") is None, "there is no place to write it"


def test_a_refused_renaming_leaves_no_traceback_in_the_log(tmp_path: Path) -> None:
    """A session as an editor holds it, with what the server writes to its log."""
    uri = (tmp_path / "reactor.gb").as_uri()
    at = {"line": 5, "character": 6}
    asked: list[dict[str, object]] = [
        {"id": 1, "method": "initialize", "params": {"capabilities": {}, "processId": None, "rootUri": None}},
        {"method": "initialized", "params": {}},
        {"method": "textDocument/didOpen",
         "params": {"textDocument": {"uri": uri, "languageId": "gb", "version": 1, "text": TEXT}}},
        {"id": 2, "method": "textDocument/rename",
         "params": {"textDocument": {"uri": uri}, "position": at, "newName": "exp"}},
        {"id": 3, "method": "shutdown"},
        {"method": "exit"},
    ]  # fmt: skip
    bodies = [json.dumps({"jsonrpc": "2.0", **one}).encode() for one in asked]
    sent = b"".join(b"Content-Length: %d\r\n\r\n%s" % (len(body), body) for body in bodies)
    done = subprocess.run([sys.executable, "-m", "gbspec", "lsp"], input=sent, capture_output=True, timeout=300,
                          check=False)  # fmt: skip
    assert done.returncode == 0
    assert b"is a word of the language" in done.stdout  # the refusal with its reason, as the answer
    assert done.stderr == b""
