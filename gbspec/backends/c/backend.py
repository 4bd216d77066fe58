"""The output form `c`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.backends import Backend, Refusal

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Method, Model


def make(model: Model, instance: GeneratedModule, method: Method) -> str | Refusal:
    """C source with the instance's numbers in it, or a refusal of a model with algebraic variables or delays."""
    from gbspec.backends.c.source import c_code

    if model.algebraics:
        why = "its algebraic variables are found by a search, which C code does not contain"
        return Refusal(why, "the form `module` has it")
    if model.delays:
        why = "its delays look at the solution before, which the program would have to keep"
        return Refusal(why, "the form `module` has it")
    return c_code(instance)


HELP = "right-hand side, Jacobian and step in C, with the numbers of a run or of the model's truth"

BACKEND = Backend("c", ".c", HELP, make, numbers=True)
