"""The output form `ir`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.ir.methods import Method
    from gbspec.ir.model import Model


def make(model: Model, instance: Any, method: Method) -> str:
    """The Model, part by part."""
    from gbspec.ir.dump import dump

    return dump(model)


BACKEND = Backend("ir", ".ir.txt", "what the compiler understood, as text", make)
