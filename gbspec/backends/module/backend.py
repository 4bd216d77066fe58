"""The form `module`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.ir.model import Model


def make(model: Model, instance: Any) -> str:
    """The standalone Python module."""
    from gbspec.backends.module import generate

    return generate(model)


BACKEND = Backend("module", ".py", "a Python module", make)
