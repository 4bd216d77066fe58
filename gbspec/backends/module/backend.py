"""The form `module`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.ir import Method, Model


def make(model: Model, instance: Any, method: Method) -> str:
    """The standalone Python module."""
    from gbspec.backends.module import generate

    return generate(model, method)


BACKEND = Backend("module", ".py", "a Python module", make)
