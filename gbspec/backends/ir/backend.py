"""The output form `ir`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Method, Model


def make(model: Model, instance: GeneratedModule | None, method: Method) -> str:
    """The Model, part by part."""
    from gbspec.ir import dump

    return dump(model)


BACKEND = Backend("ir", ".ir.txt", "what the compiler understood, as text", make)
