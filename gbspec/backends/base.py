"""What a backend registers, and how it refuses a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gbspec.diagnostics import Defect, Diagnostic, UserError
from gbspec.ir import RK4, Method

if TYPE_CHECKING:
    from gbspec.backends.protocol import GeneratedModule
    from gbspec.ir import Model


@dataclass(frozen=True)
class Refusal:
    """A backend cannot express a model: the reason as a clause (`it has no states`), and a remedy."""

    reason: str
    help: str = ""


@dataclass(frozen=True)
class Backend:
    """A form that a model can be compiled to.

    `name` is the value of `--emit`; `suffix` (with the dot) is that of its files; `help` describes them in a line.
    `make` returns their content for a verified Model, or a refusal: bytes if `binary`, else a text that ends with a
    line end. A backend that writes `numbers` (what was learned, or the truth) also gets an instance of the generated
    module with weights; for others it is None. The method is that of the integration steps, if the form has any.
    `make` imports what it needs when it is called, because the command line lists every backend.
    """

    name: str
    suffix: str
    help: str
    make: Callable[[Model, Any, Method], str | bytes | Refusal]
    binary: bool = False
    numbers: bool = False

    def emit(self, model: Model, instance: GeneratedModule | None = None, method: Method = RK4) -> str | bytes:
        """The content of its file for a Model and, if the backend writes numbers, an instance of the Model's module.

        Raises `UserError` (GB808) if it cannot express the model.
        """
        if self.numbers and instance is None:
            raise Defect(f"the backend `{self.name}` was asked for the model `{model.name}` without its numbers")
        made = self.make(model, instance, method)
        if isinstance(made, Refusal):
            message = f"the form `{self.name}` cannot express the model `{model.name}`: {made.reason}"
            raise UserError([Diagnostic("GB808", message, None, help=made.help)])
        if isinstance(made, bytes) != self.binary:
            raise Defect(f"the backend `{self.name}` emits {type(made).__name__}, and it is registered otherwise")
        return made
