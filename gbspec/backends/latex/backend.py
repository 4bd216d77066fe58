"""The output form `latex`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Method, Model


def make(model: Model, instance: GeneratedModule | None, method: Method) -> str:
    """A LaTeX document."""
    from gbspec.backends.latex import document

    return document(model)


BACKEND = Backend("latex", ".tex", "a page of typeset equations", make)
