"""Incomplete files: for any content, every request has an answer or a refusal."""

from __future__ import annotations

from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from gbspec.data.shipped import shipped_models
from gbspec.lsp.completion import completions
from gbspec.lsp.hover import hover
from gbspec.lsp.outline import outline
from gbspec.lsp.references import Refused, definitions, references, rename
from gbspec.lsp.workspace import Workspace, key

TEXTS = [path.read_text(encoding="utf-8") for _, path in sorted(shipped_models().items())]
PIECES = [*"()[]'=,:# \n\r\"", "μ", "𝒙", "in ", "unknown f(x)", "truth ", "0", "->", "\ufeff"]
FOLDER = Path("a folder that is not there")


@st.composite
def broken(draw: st.DrawFn) -> tuple[str, int]:
    """A model with a few places overwritten or cut, and an offset."""
    text = draw(st.sampled_from(TEXTS))
    for _ in range(draw(st.integers(0, 4))):
        start = draw(st.integers(0, len(text)))
        text = text[:start] + draw(st.sampled_from(PIECES)) + text[start + draw(st.sampled_from([0, 0, 1, 7, 60])) :]
    return text, draw(st.integers(0, max(0, len(text.replace("\r\n", "\n").lstrip("\ufeff")) - 1)))


@settings(deadline=None, max_examples=60)
@given(broken(), st.sampled_from(["y_new", "x", "k", "φ"]))
def test_every_question_is_answered(made: tuple[str, int], name: str) -> None:
    text, offset = made
    workspace, path = Workspace(), FOLDER / "mutated.gb"
    workspace.put(path, text)
    source = workspace.source(path)
    offset = min(offset, len(source.text))
    hover(workspace, path, offset, {})
    start, found = completions(workspace, path, offset)
    assert 0 <= start <= offset
    assert all(candidate.text for candidate in found)
    for span in definitions(workspace, path, offset):
        assert 0 <= span.start <= span.end <= len(span.source.text)
    here = references(workspace, path, offset)
    parsed = workspace.parsed(path)
    assert parsed is not None
    outline(parsed.file)
    try:
        places = rename(workspace, path, offset, name).places
    except Refused:
        return
    assert set(places[key(path)]) == {o.span for o in here if not o.implied}
