"""The forms that `gbspec compile --emit` writes: one line a backend."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from gbspec.backends.latex import document
from gbspec.backends.module import generate
from gbspec.diagnostics import Defect
from gbspec.ir.dump import dump
from gbspec.ir.methods import RK4, Method
from gbspec.ir.model import Model


class Backend(Protocol):
    """What can be asked of a backend."""

    @property
    def name(self) -> str:
        """Its name after `--emit`."""
        ...

    @property
    def suffix(self) -> str:
        """The usual suffix of its files, with the dot."""
        ...

    @property
    def numbers(self) -> bool:
        """Whether it writes down what was learned, or the truth: whether `emit` needs an instance."""
        ...

    def emit(self, model: Model, instance: Any = None, method: Method = RK4) -> str:
        """The text for a verified model that a method steps, or for an instance of its generated module with weights
        (which has its own)."""
        ...


@dataclass(frozen=True)
class ModelText:
    """A backend that needs the model alone."""

    name: str
    suffix: str
    text: Callable[[Model, Method], str]
    numbers: bool = False

    def emit(self, model: Model, instance: Any = None, method: Method = RK4) -> str:
        """The text for the model; an instance changes nothing."""
        return self.text(model, method)


@dataclass(frozen=True)
class InstanceText:
    """A backend that writes numbers: weights and constants."""

    name: str
    suffix: str
    text: Callable[[Any], str]
    numbers: bool = True

    def emit(self, model: Model, instance: Any = None, method: Method = RK4) -> str:
        """The text for an instance of the model's module; a Defect without one."""
        if instance is None:
            raise Defect(f"the backend `{self.name}` was asked for the model `{model.name}` without its numbers")
        return self.text(instance)


def _c_code(instance: Any) -> str:
    from gbspec.backends.casadi.c_code import c_code  # casadi takes a while to load

    return c_code(instance)


_ALL: tuple[Backend, ...] = (
    ModelText("module", ".py", generate),
    ModelText("ir", ".ir.txt", lambda model, _: dump(model)),
    ModelText("latex", ".tex", lambda model, _: document(model)),
    InstanceText("c", ".c", _c_code),
)

BACKENDS: Mapping[str, Backend] = {backend.name: backend for backend in _ALL}
"""Every backend by its name; the first is the default."""
