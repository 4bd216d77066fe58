"""The output form `native`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gbspec.backends import Backend, Refusal

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Method, Model


def make(model: Model, instance: GeneratedModule | None, method: Method) -> str | Refusal:
    """The kernel in double precision, or a refusal that names the form of the model that it does not cover."""
    from gbspec.backends.native import NotCoveredError, source

    try:
        return source(model, method=method).text
    except NotCoveredError as problem:
        return Refusal(str(problem), "the form `module` expresses every model; training falls back on it")


HELP = "the C kernel that training compiles: solution, gradient and Jacobian of a batch"

BACKEND = Backend("native", ".c", HELP, make)
