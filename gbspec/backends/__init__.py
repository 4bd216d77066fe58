"""Backends, one folder each: they translate a Model to other languages and to functions.

A folder whose `backend.py` defines `BACKEND` is an output form of `gbspec compile --emit`; `registry` finds it.
`printing` holds what backends share; they do not import each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gbspec.diagnostics import Defect, Diagnostic, UserError
from gbspec.ir.methods import RK4, Method

if TYPE_CHECKING:
    from gbspec.ir.model import Model


@dataclass(frozen=True)
class Refusal:
    """The answer of a backend that cannot express a model: a reason as a clause (`it has no states`), and a remedy."""

    reason: str
    help: str = ""


@dataclass(frozen=True)
class Backend:
    """A form that a model can be compiled to.

    `name` is the value of `--emit`, `suffix` (with the dot) that of the file name; `help` describes the file in one
    line. `make` returns its content for a verified Model, or a `Refusal`: bytes if `binary`, else a text that ends with
    a newline. A backend that writes `numbers` (learned, or of the truth) also gets an instance of the generated module
    with weights; others get None. The method is the one that takes the steps, if the form has any. `make` imports what
    it needs when it is called, since the command line lists every backend.
    """

    name: str
    suffix: str
    help: str
    make: Callable[[Model, Any, Method], str | bytes | Refusal]
    binary: bool = False
    numbers: bool = False

    def emit(self, model: Model, instance: Any = None, method: Method = RK4) -> str | bytes:
        """The content of the file for a Model, and for an instance of its module if the backend needs one.

        Raises `UserError` (GB808) if the backend cannot express the model.
        """
        if self.numbers and instance is None:
            raise Defect(f"the backend `{self.name}` was asked for the model `{model.name}` without its numbers")
        made = self.make(model, instance, method)
        if isinstance(made, Refusal):
            message = f"the form `{self.name}` cannot express the model `{model.name}`: {made.reason}"
            raise UserError([Diagnostic("GB808", message, None, help=made.help)])
        if isinstance(made, bytes) != self.binary:
            raise Defect(f"the backend `{self.name}` emits {type(made).__name__}, not the registered type")
        return made
