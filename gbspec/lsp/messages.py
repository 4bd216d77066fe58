"""Converts results to the protocol's messages, and the protocol's positions to offsets."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from lsprotocol import types
from pygls.uris import from_fs_path, to_fs_path

from gbspec.diagnostics import Diagnostic, Severity, Source, Span
from gbspec.lsp.completion import Candidate
from gbspec.lsp.outline import Group
from gbspec.lsp.positions import Encoding, to_offset, to_range
from gbspec.lsp.semantic import MODIFIERS, TYPES, Token
from gbspec.lsp.signatures import Signature

_MEANT = re.compile(r"did you mean `(\w+)`\?")

_COMPLETION = {
    "keyword": types.CompletionItemKind.Keyword,
    "name": types.CompletionItemKind.Variable,
    "function": types.CompletionItemKind.Function,
    "unit": types.CompletionItemKind.Unit,
    "value": types.CompletionItemKind.Value,
    "file": types.CompletionItemKind.File,
}


def path_of(uri: str) -> str:
    """The path of a file; for an unsaved text its URI."""
    path = to_fs_path(uri) if uri.startswith("file:") else None
    return path or uri


def uri_of(path: str | Path) -> str:
    """The URI of a file."""
    made = from_fs_path(str(path))
    return made if made is not None else str(path)


class Messages:
    """Builds messages with columns in the editor's encoding; `link` is where the explanation of a code is."""

    def __init__(self, encoding: Encoding, link: Callable[[str], str | None] = lambda code: None) -> None:
        self.encoding = encoding
        self.link = link

    def offset(self, source: Source, position: types.Position) -> int:
        """The offset of an editor's position."""
        return to_offset(source, (position.line, position.character), self.encoding)

    def range(self, span: Span) -> types.Range:
        """An editor's range of a span."""
        (line, column), (end_line, end_column) = to_range(span, self.encoding)
        return types.Range(types.Position(line, column), types.Position(end_line, end_column))

    def location(self, span: Span, uri: str | None = None) -> types.Location:
        """A span with its file."""
        return types.Location(uri or uri_of(span.source.path), self.range(span))

    def diagnostic(self, found: Diagnostic) -> types.Diagnostic:
        """The message for a diagnostic whose place is a span; notes and help follow its message."""
        assert isinstance(found.place, Span)
        lines = [found.message, *(f"note: {note}" for note in found.notes)]
        lines += [f"help: {found.help}"] if found.help else []
        labels = [types.DiagnosticRelatedInformation(self.location(m.span), m.text) for m in found.labels]
        warning = found.severity is Severity.WARNING
        link = self.link(found.code)
        return types.Diagnostic(
            range=self.range(found.place),
            message="\n".join(lines),
            severity=types.DiagnosticSeverity.Warning if warning else types.DiagnosticSeverity.Error,
            code=found.code,
            code_description=None if link is None else types.CodeDescription(link),
            source="gbspec",
            related_information=labels or None,
            tags=[types.DiagnosticTag.Unnecessary] if found.code == UNUSED else None,
        )

    def tokens(self, found: Sequence[Token]) -> types.SemanticTokens:
        """Tokens in the order of the text, each relative to the one before it."""
        data: list[int] = []
        line = column = 0
        for token in found:
            place = self.range(token.span)
            down = place.start.line - line
            right = place.start.character - (0 if down else column)
            line, column = place.start.line, place.start.character
            modifiers = sum(1 << MODIFIERS.index(name) for name in token.modifiers)
            data += [down, right, place.end.character - column, TYPES.index(token.type), modifiers]
        return types.SemanticTokens(data)

    def signature(self, found: Signature) -> types.SignatureHelp:
        """The help on one call; the places of its parameters count UTF-16, whatever the encoding of columns is."""
        label = found.label

        def units(end: int) -> int:
            return len(label[:end].encode("utf-16-le")) // 2

        parameters = [types.ParameterInformation((units(start), units(end))) for start, end in found.parameters]
        said = types.MarkupContent(types.MarkupKind.Markdown, found.documentation)
        information = types.SignatureInformation(label, said, parameters, active_parameter=found.active)
        return types.SignatureHelp([information], active_signature=0, active_parameter=found.active)

    def completion(self, candidate: Candidate, place: Span) -> types.CompletionItem:
        """A candidate that replaces the part of a word before the cursor."""
        return types.CompletionItem(
            label=candidate.text,
            kind=_COMPLETION[candidate.kind],
            detail=candidate.detail or None,
            documentation=candidate.documentation or None,
            text_edit=types.TextEdit(self.range(place), candidate.text),
        )

    def symbols(self, group: Group) -> types.DocumentSymbol:
        """A group of names with the names in it."""
        kind = types.SymbolKind[group.statement.entry.symbol]
        below = [
            types.DocumentSymbol(
                name=entry.name,
                kind=kind,
                range=self.range(entry.span),
                selection_range=self.range(entry.name_span),
                detail=entry.detail,
            )
            for entry in group.entries
        ]
        spans = [entry.span for entry in group.entries]
        first = group.entries[0].name_span
        whole = self.range(Span(first.source, min(s.start for s in spans), max(s.end for s in spans)))
        return types.DocumentSymbol(
            name=group.title,
            kind=types.SymbolKind.Namespace,
            range=whole,
            selection_range=self.range(spans[0]),
            children=below,
        )

    def actions(self, found: Diagnostic, uri: str) -> list[types.CodeAction]:
        """The quick fixes of a diagnostic: replacing a name by the suggested one, or accepting the warning."""
        actions: list[types.CodeAction] = []
        if not isinstance(found.place, Span):
            return actions
        span = found.place
        meant = _MEANT.search(found.help)
        if meant is not None and span.text.isidentifier():
            edit = types.TextEdit(self.range(span), meant[1])
            actions.append(self._action(f"Replace `{span.text}` by `{meant[1]}`", found, uri, edit, preferred=True))
        if found.severity is Severity.WARNING:
            text = " ".join(part for part in ("allow", found.code, found.subject) if part)
            end = Span(span.source, len(span.source.text), len(span.source.text))
            newline = "" if span.source.text.endswith("\n") else "\n"
            edit = types.TextEdit(self.range(end), f"{newline}{text}\n")
            actions.append(self._action(f"Accept this warning: `{text}`", found, uri, edit))
        return actions

    def _action(
        self, title: str, found: Diagnostic, uri: str, edit: types.TextEdit, *, preferred: bool = False
    ) -> types.CodeAction:
        return types.CodeAction(
            title=title,
            kind=types.CodeActionKind.QuickFix,
            diagnostics=[self.diagnostic(found)],
            edit=types.WorkspaceEdit(changes={uri: [edit]}),
            is_preferred=preferred or None,
        )


UNUSED = "GB403"
"""The code of a name that nothing uses, which editors show faded."""
