"""The forms that `gbspec compile --emit` writes: one line a backend."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from gbspec.backends.module import generate
from gbspec.ir.dump import dump
from gbspec.ir.model import Model


class Backend(Protocol):
    """What can be asked of a backend: its name after `--emit`, the suffix of its files, the text for a model."""

    @property
    def name(self) -> str:
        """Its name on the command line."""
        ...

    @property
    def suffix(self) -> str:
        """The usual suffix of its files, with the dot."""
        ...

    @property
    def emit(self) -> Callable[[Model], str]:
        """The text for a verified model; raises `Defect` alone."""
        ...


@dataclass(frozen=True)
class TextBackend:
    """A backend that is a function from a model to a text."""

    name: str
    suffix: str
    emit: Callable[[Model], str]


_ALL: tuple[Backend, ...] = (
    TextBackend("module", ".py", generate),
    TextBackend("ir", ".ir.txt", dump),
)

BACKENDS: Mapping[str, Backend] = {backend.name: backend for backend in _ALL}
"""Every backend by its name; the first is the default."""
