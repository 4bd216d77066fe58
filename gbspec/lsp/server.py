"""The language server: answers an editor's requests from a workspace, over standard input and output."""

from __future__ import annotations

import asyncio
import functools
import logging
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import ParamSpec, TypeVar

from lsprotocol import types
from pygls.exceptions import JsonRpcException
from pygls.lsp.server import LanguageServer

from gbspec.diagnostics import Source, Span, UserError
from gbspec.lsp import references
from gbspec.lsp.checking import Checked, affected, check
from gbspec.lsp.completion import completions
from gbspec.lsp.explained import Explanations
from gbspec.lsp.hover import hover
from gbspec.lsp.messages import Messages, path_of, uri_of
from gbspec.lsp.outline import outline
from gbspec.lsp.semantic import MODIFIERS, TYPES, tokens
from gbspec.lsp.signatures import signature
from gbspec.lsp.workspace import Workspace, key
from gbspec.syntax import format_text
from gbspec.version import __version__

DELAY = 0.15
"""Seconds without a change after which a file is checked."""
REQUEST_FAILED = -32803
"""The protocol's error code for a valid request that cannot be fulfilled."""

log = logging.getLogger("gbspec.lsp")
P = ParamSpec("P")
R = TypeVar("R")


@dataclass
class Session:
    """The open files, their latest diagnostics, and the running checks."""

    server: LanguageServer
    workspace: Workspace = field(default_factory=Workspace)
    checked: dict[Path, Checked] = field(default_factory=dict)
    uris: dict[Path, str] = field(default_factory=dict)
    pending: dict[Path, asyncio.Task[None]] = field(default_factory=dict)
    explanations: Explanations = field(default_factory=Explanations)
    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "check"))

    @property
    def messages(self) -> Messages:
        """The converter of messages in the encoding negotiated with the editor."""
        agreed = self.server.workspace.position_encoding or types.PositionEncodingKind.Utf16
        return Messages(types.PositionEncodingKind(agreed).value, self.explanations.link)

    # ------------------------------------------------------------------------------------------------------ checking

    def opened(self, uri: str, text: str, delay: float) -> None:
        """Stores a new text; it and all open files that extend it are checked after a pause without changes."""
        path = path_of(uri)
        self.uris[key(path)] = uri
        self.workspace.put(path, text)
        self.schedule(path, delay)

    def closed(self, uri: str) -> None:
        """Forgets a closed file and its diagnostics; open files that extend it are checked again."""
        path = path_of(uri)
        task = self.pending.pop(key(path), None)
        if task is not None:
            task.cancel()
        self.workspace.drop(path)
        self.checked.pop(key(path), None)
        self.uris.pop(key(path), None)
        self.server.text_document_publish_diagnostics(types.PublishDiagnosticsParams(uri, []))
        self.schedule(path, 0)

    def schedule(self, path: str | Path, delay: float) -> None:
        """Checks the open files that depend on a file after a delay; a pending check is postponed."""
        for dependent in affected(self.workspace, path):
            waiting = self.pending.get(dependent)
            if waiting is not None:
                waiting.cancel()
            self.pending[dependent] = asyncio.get_running_loop().create_task(self._check(dependent, delay))

    async def _check(self, path: Path, delay: float) -> None:
        await asyncio.sleep(delay)
        snapshot = self.workspace.with_texts({})
        source = snapshot.source(path)
        try:
            checked = await asyncio.get_running_loop().run_in_executor(self.pool, check, snapshot, source.path)
        except asyncio.CancelledError:
            raise
        except Exception:  # a defect must not end the session; the next change starts another check
            log.exception("checking %s failed", path)
            return
        uri = self.uris.get(path)
        if uri is not None and self.workspace.source(path) is source:
            self.checked[path] = checked
            found = [self.messages.diagnostic(d) for d in checked.findings]
            version = self.server.workspace.get_text_document(uri).version
            self.server.text_document_publish_diagnostics(types.PublishDiagnosticsParams(uri, found, version))

    # ------------------------------------------------------------------------------------------------------- places

    def place(self, document: types.TextDocumentIdentifier, position: types.Position) -> tuple[str, int]:
        """The path and offset of a position; raises `UserError` if there is no such file."""
        path = path_of(document.uri)
        return path, self.messages.offset(self.workspace.source(path), position)

    def location(self, span: Span) -> types.Location:
        """A span with the URI by which the editor knows its file."""
        return self.messages.location(span, self.uris.get(key(span.source.path)))


def _not_refused(record: logging.LogRecord) -> bool:
    """Whether a log record is about something else than a refusal, which the editor shows with its reason."""
    error = record.exc_info[1] if record.exc_info else None
    return not (isinstance(error, JsonRpcException) and error.code == REQUEST_FAILED)


def guarded(handler: Callable[P, R]) -> Callable[P, R | None]:
    """Wraps a handler: failures are logged and answered with None; a refusal is passed on."""

    @functools.wraps(handler)
    def call(*args: P.args, **kwargs: P.kwargs) -> R | None:
        try:
            return handler(*args, **kwargs)
        except references.Refused as refusal:
            raise JsonRpcException(str(refusal), REQUEST_FAILED) from refusal
        except UserError as error:  # a file that no longer exists or is not text: no answer
            log.info("%s", error)
        except Exception:
            log.exception("%s failed", handler.__name__)
        return None

    return call


def create() -> LanguageServer:
    """A server with all its handlers."""
    server = LanguageServer(
        "gbspec", __version__, text_document_sync_kind=types.TextDocumentSyncKind.Full, max_workers=2
    )
    # pygls logs every error that answers a request, with its traceback; a refusal is an answer like any other
    logging.getLogger("pygls.protocol.json_rpc").addFilter(_not_refused)
    session = Session(server)
    _documents(server, session)
    _names(server, session)
    _writing(server, session)
    return server


def serve() -> None:
    """Serves one editor over standard input and output until it sends `exit`; printed output goes to the log."""
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="gbspec lsp: %(levelname)s: %(message)s")
    output, sys.stdout = sys.stdout.buffer, sys.stderr
    create().start_io(sys.stdin.buffer, output)


def _documents(server: LanguageServer, session: Session) -> None:
    """Registers the handlers for opening, changing and closing files."""

    @server.feature(types.INITIALIZED)
    @guarded
    def initialized(params: types.InitializedParams) -> None:
        folders = server.workspace.folders.values()
        session.workspace.roots = tuple(Path(path_of(folder.uri)) for folder in folders)

    @server.feature(types.TEXT_DOCUMENT_DID_OPEN)
    @guarded
    def did_open(params: types.DidOpenTextDocumentParams) -> None:
        session.opened(params.text_document.uri, params.text_document.text, 0)

    @server.feature(types.TEXT_DOCUMENT_DID_CHANGE)
    @guarded
    def did_change(params: types.DidChangeTextDocumentParams) -> None:
        uri = params.text_document.uri
        session.opened(uri, server.workspace.get_text_document(uri).source, DELAY)

    @server.feature(types.TEXT_DOCUMENT_DID_CLOSE)
    @guarded
    def did_close(params: types.DidCloseTextDocumentParams) -> None:
        session.closed(params.text_document.uri)

    @server.feature(types.WORKSPACE_DID_CHANGE_WATCHED_FILES)
    @guarded
    def did_change_watched_files(params: types.DidChangeWatchedFilesParams) -> None:
        for change in params.changes:
            session.schedule(path_of(change.uri), DELAY)


def _names(server: LanguageServer, session: Session) -> None:
    """Registers the handlers for hover, definition, references, renaming and outline."""

    @server.feature(types.TEXT_DOCUMENT_HOVER)
    @guarded
    def show(params: types.HoverParams) -> types.Hover | None:
        path, offset = session.place(params.text_document, params.position)
        last = session.checked.get(key(path))
        found = hover(session.workspace, path, offset, last.values if last is not None else {})
        if found is None:
            return None
        content = types.MarkupContent(types.MarkupKind.Markdown, found.markdown)
        return types.Hover(content, session.messages.range(found.span))

    @server.feature(types.TEXT_DOCUMENT_DEFINITION)
    @guarded
    def definition(params: types.DefinitionParams) -> list[types.Location]:
        path, offset = session.place(params.text_document, params.position)
        return [session.location(span) for span in references.definitions(session.workspace, path, offset)]

    @server.feature(types.TEXT_DOCUMENT_REFERENCES)
    @guarded
    def find(params: types.ReferenceParams) -> list[types.Location]:
        path, offset = session.place(params.text_document, params.position)
        found = references.references(session.workspace, path, offset)
        wanted = [o for o in found if not o.declares or params.context.include_declaration]
        return [session.location(o.span) for o in wanted]

    @server.feature(types.TEXT_DOCUMENT_PREPARE_RENAME)
    @guarded
    def prepare_rename(params: types.PrepareRenameParams) -> types.PrepareRenamePlaceholder:
        path, offset = session.place(params.text_document, params.position)
        span = references.renamable(session.workspace, path, offset).span
        return types.PrepareRenamePlaceholder(session.messages.range(span), span.text)

    @server.feature(types.TEXT_DOCUMENT_RENAME, types.RenameOptions(prepare_provider=True))
    @guarded
    def rename(params: types.RenameParams) -> types.WorkspaceEdit:
        path, offset = session.place(params.text_document, params.position)
        made = references.rename(session.workspace, path, offset, params.new_name)
        return types.WorkspaceEdit(
            changes={
                session.uris.get(file) or uri_of(file): [
                    types.TextEdit(session.messages.range(span), made.name) for span in spans
                ]
                for file, spans in made.places.items()
            }
        )

    @server.feature(types.TEXT_DOCUMENT_DOCUMENT_SYMBOL)
    @guarded
    def document_symbol(params: types.DocumentSymbolParams) -> list[types.DocumentSymbol]:
        parsed = session.workspace.parsed(path_of(params.text_document.uri))
        return [session.messages.symbols(group) for group in outline(parsed.file)] if parsed is not None else []

    @server.feature(types.TEXT_DOCUMENT_SEMANTIC_TOKENS_FULL, types.SemanticTokensLegend(list(TYPES), list(MODIFIERS)))
    @guarded
    def semantic_tokens(params: types.SemanticTokensParams) -> types.SemanticTokens:
        return session.messages.tokens(tokens(session.workspace, path_of(params.text_document.uri)))


def _writing(server: LanguageServer, session: Session) -> None:
    """Registers the handlers for completion, signatures, formatting and quick fixes."""

    @server.feature(types.TEXT_DOCUMENT_SIGNATURE_HELP, types.SignatureHelpOptions(trigger_characters=["(", ","]))
    @guarded
    def signature_help(params: types.SignatureHelpParams) -> types.SignatureHelp | None:
        found = signature(session.workspace, *session.place(params.text_document, params.position))
        return None if found is None else session.messages.signature(found)

    @server.feature(types.TEXT_DOCUMENT_COMPLETION, types.CompletionOptions(trigger_characters=['"', ":"]))
    @guarded
    def completion(params: types.CompletionParams) -> types.CompletionList:
        path, offset = session.place(params.text_document, params.position)
        source = session.workspace.source(path)
        start, found = completions(session.workspace, path, offset)
        place = Span(source, start, offset)
        once = {candidate.text: candidate for candidate in reversed(found)}
        items = [session.messages.completion(candidate, place) for candidate in reversed(once.values())]
        return types.CompletionList(is_incomplete=False, items=items)

    @server.feature(types.TEXT_DOCUMENT_FORMATTING)
    @guarded
    def formatting(params: types.DocumentFormattingParams) -> list[types.TextEdit]:
        source = session.workspace.source(path_of(params.text_document.uri))
        return _formatted(session, source)

    @server.feature(
        types.TEXT_DOCUMENT_CODE_ACTION, types.CodeActionOptions(code_action_kinds=[types.CodeActionKind.QuickFix])
    )
    @guarded
    def code_action(params: types.CodeActionParams) -> list[types.CodeAction]:
        uri = params.text_document.uri
        path = path_of(uri)
        source, last = session.workspace.source(path), session.checked.get(key(path))
        if last is None or last.source is not source:
            return []
        start = session.messages.offset(source, params.range.start)
        end = session.messages.offset(source, params.range.end)
        near = [d for d in last.findings if isinstance(d.place, Span) and d.place.start <= end and start <= d.place.end]
        return [action for found in near for action in session.messages.actions(found, uri)]


def _formatted(session: Session, source: Source) -> list[types.TextEdit]:
    """One edit of the lines that change; none if the text is canonical; raises `UserError` if it does not parse."""
    new = format_text(source)
    old_lines, new_lines = source.text.splitlines(keepends=True), new.splitlines(keepends=True)
    head = _common(old_lines, new_lines)
    tail = _common(old_lines[head:][::-1], new_lines[head:][::-1])
    if head == len(old_lines) == len(new_lines):
        return []
    start = len("".join(old_lines[:head]))
    end = len(source.text) - len("".join(old_lines[len(old_lines) - tail :]))
    text = "".join(new_lines[head : len(new_lines) - tail])
    return [types.TextEdit(session.messages.range(Span(source, start, end)), text)]


def _common(first: list[str], second: list[str]) -> int:
    """The number of equal lines at the beginning."""
    pairs = zip(first, second, strict=False)
    return next((i for i, (a, b) in enumerate(pairs) if a != b), min(len(first), len(second)))
