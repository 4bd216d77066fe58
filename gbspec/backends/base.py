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
    """That a backend cannot express a model: the reason as a clause (`it has no states`), and what can be done."""

    reason: str
    help: str = ""


@dataclass(frozen=True)
class Backend:
    """A form that a model can be compiled to.

    `name` stands after `--emit`; `suffix` (with the dot) is that of its files; `help` says in a line what they are.
    `make` gives what they hold for a verified Model, or why it cannot: bytes if `binary`, else a text that ends with a
    line end. A backend that writes `numbers` (what was learned, or the truth) also gets an instance of the generated
    module with weights; for others it is None. The method is that of the steps, where the form has any. `make` imports
    what it needs when it is called: the command line lists every backend.
    """

    name: str
    suffix: str
    help: str
    make: Callable[[Model, Any, Method], str | bytes | Refusal]
    binary: bool = False
    numbers: bool = False

    def emit(self, model: Model, instance: GeneratedModule | None = None, method: Method = RK4) -> str | bytes:
        """What its file holds for a Model, and an instance of its module where it needs one.

        Raises `UserError` (GB808) where it cannot express the model.
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
