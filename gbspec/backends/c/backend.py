"""The form `c`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Method, Model


def make(model: Model, instance: GeneratedModule, method: Method) -> str:
    """C with the instance's numbers in it."""
    from gbspec.backends.c.source import c_code

    return c_code(instance)


HELP = "right-hand side, Jacobian and step in C, with the numbers of a run or of the model's truth"

BACKEND = Backend("c", ".c", HELP, make, numbers=True)
