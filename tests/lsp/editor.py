"""An editor for the tests: a client that speaks the protocol with `gbspec lsp` in a separate process."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, TypeVar

from lsprotocol import types
from pygls.lsp.client import LanguageClient

T = TypeVar("T")
PATIENCE = 300
"""Seconds after which an answer counts as lost; a correct server answers much earlier."""


class Editor:
    """Opens and changes files; keeps the diagnostics that the server published last for each."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.client = LanguageClient("test-editor", "1")
        self.published: dict[str, types.PublishDiagnosticsParams] = {}
        self.news = asyncio.Condition()
        self.versions: dict[str, int] = {}

        @self.client.feature(types.TEXT_DOCUMENT_PUBLISH_DIAGNOSTICS)
        async def publish(params: types.PublishDiagnosticsParams) -> None:
            async with self.news:
                self.published[params.uri] = params
                self.news.notify_all()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        return self.loop.run_until_complete(asyncio.wait_for(work, PATIENCE))

    def start(self, encodings: list[str] | None = None) -> types.InitializeResult:
        async def start() -> types.InitializeResult:
            await self.client.start_io(sys.executable, "-m", "gbspec", "lsp")
            general = types.GeneralClientCapabilities(position_encodings=encodings) if encodings else None
            capabilities = types.ClientCapabilities(general=general)
            result = await self.client.initialize_async(types.InitializeParams(capabilities))
            self.client.initialized(types.InitializedParams())
            return result

        return self.run(start())

    def stop(self) -> int | None:
        async def stop() -> int | None:
            await self.client.shutdown_async(None)
            self.client.exit(None)
            process = self.client._server
            assert process is not None
            return await process.wait()

        status = self.run(stop())
        self.run(self.client.stop())
        self.loop.close()
        return status

    def open(self, path: Path, text: str | None = None) -> str:
        """Opens a file (with a text that may differ from the disk's) and returns its address."""
        uri = path.as_uri()
        content = path.read_text() if text is None else text
        self.versions[uri] = 1
        self.published.pop(uri, None)
        self.send(
            self.client.text_document_did_open,
            types.DidOpenTextDocumentParams(types.TextDocumentItem(uri, "gb", 1, content)),
        )
        return uri

    def change(self, uri: str, text: str) -> None:
        self.versions[uri] += 1
        self.published.pop(uri, None)
        identifier = types.VersionedTextDocumentIdentifier(self.versions[uri], uri)
        change = types.TextDocumentContentChangeWholeDocument(text)
        self.send(self.client.text_document_did_change, types.DidChangeTextDocumentParams(identifier, [change]))

    def send(self, notification: Any, params: Any) -> None:
        async def send() -> None:
            notification(params)
            await asyncio.sleep(0)

        self.run(send())

    def findings(self, uri: str) -> list[types.Diagnostic]:
        """The diagnostics published since the file was opened or changed last."""

        async def wait() -> list[types.Diagnostic]:
            async with self.news:
                await self.news.wait_for(lambda: uri in self.published and self._is_news(uri))
            return list(self.published[uri].diagnostics)

        return self.run(wait())

    def _is_news(self, uri: str) -> bool:
        """Whether the latest diagnostics are those of the latest text (a closed file has no version)."""
        return self.published[uri].version in (None, self.versions.get(uri))

    def codes(self, uri: str) -> list[str]:
        return [str(d.code) for d in self.findings(uri)]

    def ask(self, request: Any, params: Any) -> Any:
        return self.run(request(params))


def place(text: str, what: str, after: int = 0) -> types.Position:
    """The position of a string in a text, in UTF-16."""
    at = text.index(what)
    start = text.rfind("\n", 0, at) + 1
    return types.Position(text.count("\n", 0, at), len(text[start:at].encode("utf-16-le")) // 2 + after)
