"""The output form `c`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gbspec.backends import Backend

if TYPE_CHECKING:
    from gbspec.ir.methods import Method
    from gbspec.ir.model import Model


def make(model: Model, instance: Any, method: Method) -> str:
    """C source with the instance's numbers in it."""
    from gbspec.backends.c.source import c_code

    return c_code(instance)


HELP = "right-hand side, Jacobian and step in C, with the numbers of a run or of the model's truth"

BACKEND = Backend("c", ".c", HELP, make, numbers=True)
