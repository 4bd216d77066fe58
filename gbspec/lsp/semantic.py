"""Semantic tokens: what each name of a file is, which highlighting by patterns cannot know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gbspec.diagnostics import Span
from gbspec.lsp.index import DEFAULT_TIME, Occurrence
from gbspec.lsp.workspace import Parsed, Workspace
from gbspec.syntax import Kind

TYPES = ("variable", "parameter", "property", "function", "type", "class", "enumMember", "event")
"""Types of tokens, all of the protocol's own, so that every colour theme knows them."""
MODIFIERS = ("declaration", "readonly", "defaultLibrary", "learned", "given")
"""`learned`: what is fitted to data; `given`: what the data give (conditions, inputs, the time)."""

_NAMES: dict[Kind, tuple[str, tuple[str, ...]]] = {
    Kind.TIME: ("property", ("readonly", "given")),
    Kind.STATE: ("variable", ()),
    Kind.CONDITION: ("property", ("readonly", "given")),
    Kind.INPUT: ("property", ("readonly", "given")),
    Kind.CONST: ("variable", ("readonly",)),
    Kind.LEARN: ("variable", ("readonly", "learned")),
    Kind.LET: ("variable", ()),
    Kind.FUNCTION: ("function", ()),
    Kind.TABLE: ("function", ("readonly",)),
    Kind.UNKNOWN: ("function", ("learned",)),
    Kind.PROCESS: ("variable", ()),
    Kind.CHANNEL: ("variable", ()),
    Kind.CLAIM: ("variable", ()),
    Kind.EVENT: ("event", ()),
    Kind.ALGEBRAIC: ("variable", ()),
    Kind.EQUATION: ("variable", ()),
}
_WORDS = {"function": "function", "value": "variable", "option": "property", "activation": "enumMember"}
"""Types of the words of the language by their kinds; the others (networks, distributions) are types."""
_SPACES = {"argument": "parameter", "unit": "type", "model": "class", "code": "enumMember"}


@dataclass(frozen=True)
class Token:
    """A name with its type and modifiers."""

    span: Span
    type: str
    modifiers: tuple[str, ...]


def tokens(workspace: Workspace, path: str | Path) -> list[Token]:
    """The tokens of a file in the order of its text; names that nothing declares have none."""
    kinds = _kinds(workspace.chain(path))
    found: dict[int, Token] = {}
    for occurrence in workspace.occurrences(path):
        made = None if occurrence.implied else _token(occurrence, kinds)
        if made is not None and made.span.text and "\n" not in made.span.text:
            found.setdefault(made.span.start, made)
    return sorted(found.values(), key=lambda token: token.span.start)


def _kinds(chain: Sequence[Parsed]) -> dict[str, Kind]:
    """The kind of every name of a model; the nearest file's declaration holds."""
    found = {DEFAULT_TIME: Kind.TIME}
    for parsed in reversed(chain):
        # An `observe` of a state names a channel like the state, which it remains
        for channels in (True, False):
            for statement in parsed.file.statements:
                kind = statement.entry.kind
                if kind is not None and (kind is Kind.CHANNEL) == channels:
                    found |= {name.text: kind for name in statement.declares()}
    return found


def _token(occurrence: Occurrence, kinds: Mapping[str, Kind]) -> Token | None:
    symbol = occurrence.symbol
    declared = ("declaration",) if occurrence.declares else ()
    if symbol.space == "word":
        fixed = ("readonly",) if symbol.home == "value" else ()
        return Token(occurrence.span, _WORDS.get(symbol.home, "type"), (*fixed, "defaultLibrary"))
    if symbol.space == "name":
        if symbol.name not in kinds:
            return None
        kind, modifiers = _NAMES[kinds[symbol.name]]
        return Token(occurrence.span, kind, (*declared, *modifiers))
    return Token(occurrence.span, _SPACES[symbol.space], declared)
