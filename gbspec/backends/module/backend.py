"""The output form `module`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Method, Model


def make(model: Model, instance: GeneratedModule | None, method: Method) -> str:
    """The standalone Python module."""
    from gbspec.backends.module import generate

    return generate(model, method)


BACKEND = Backend("module", ".py", "a Python module", make)
