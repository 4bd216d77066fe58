"""The explanation of each code as a file to which the editor links it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from gbspec.diagnostics import UserError, explain


class Explanations:
    """Explanations in a folder of this session, which only its user can write to and which ends with it."""

    def __init__(self) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._links: dict[str, str | None] = {}

    def link(self, code: str) -> str | None:
        """The URI of the explanation of a code; None if there is none, or if it cannot be written."""
        if code not in self._links:
            self._links[code] = self._written(code)
        return self._links[code]

    def _written(self, code: str) -> str | None:
        try:
            text = markdown(code)
            if self._folder is None:
                self._folder = tempfile.TemporaryDirectory(prefix="gbspec-codes-", ignore_cleanup_errors=True)
            path = Path(self._folder.name).resolve() / f"{code}.md"
            path.write_text(text, encoding="utf-8")
        except (UserError, OSError):
            return None
        return path.as_uri()


def markdown(code: str) -> str:
    """The explanation of a code with its examples. Raises `UserError` if there is no such code."""
    entry = explain(code)
    parts = [f"# {entry.code}: {entry.title}", entry.explanation.strip()]
    for heading, example in (("Wrong", entry.wrong), ("Right", entry.right)):
        if example:
            parts.append(f"## {heading}\n\n```gb\n{example.strip()}\n```")
    return "\n\n".join(parts) + "\n"
