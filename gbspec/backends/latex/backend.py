"""The output form `latex`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.backends import Backend, Refusal

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Method, Model


def make(model: Model, instance: GeneratedModule | None, method: Method) -> str | Refusal:
    """A LaTeX document, or a refusal of a model with events."""
    from gbspec.backends.latex import document

    if model.events:
        return Refusal("its events are not typeset yet", "the form `ir` shows them as text")
    return document(model)


BACKEND = Backend("latex", ".tex", "a page of typeset equations", make)
