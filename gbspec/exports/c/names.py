"""The identifiers of a model's C library."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from gbspec.exports.c.printer import distinct, identifier
from gbspec.exports.programs import Programs
from gbspec.ir import Model

FILES = frozenset(["main", "host", "gb_core", "fmi2", "fmi3", "math", "stddef", "stdio", "stdlib", "string"])
"""Names of files that stand beside the model's."""
OWN = frozenset(
    [
        "parameters",
        "course",
        "defaults",
        "initial",
        "rhs",
        "observe",
        "functions",
        "switches",
        "outside",
        "doses",
        "step",
        "simulate",
        "guards",
        "ranks",
        "timing",
        "happen",
        "algebraic",
        "move",
        "events",
        "arm",
        "due",
        "carry_out",
        "cut",
        "lags",
        "delayed",
        "history",
        "piece",
        "past",
        "begin",
        "late",
        "jump",
        "reach",
        "mark",
        "shortest",
        "keep",
    ]
)
"""What follows the prefix in names of the library itself."""


@dataclass(frozen=True)
class CNames:
    """`prefix` begins every exported name; the members of the parameters' struct have the names of the model."""

    model: Model

    @cached_property
    def prefix(self) -> str:
        """The model's name, unless a file of an export, or one of C's headers, has it."""
        name = identifier(self.model.name)
        return f"{name}_model" if name.lower() in FILES else name

    @property
    def upper(self) -> str:
        """The prefix of sizes and indices."""
        return self.prefix.upper()

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """The members of the struct: conditions, then constants."""
        names = [*(item.name for item in self.model.conditions), *self.model.constant_names]
        return tuple(distinct(names))

    @property
    def conditions(self) -> tuple[str, ...]:
        """The members that are conditions."""
        return self.parameters[: len(self.model.conditions)]

    @property
    def constants(self) -> tuple[str, ...]:
        """The members that are constants."""
        return self.parameters[len(self.model.conditions) :]

    def indices(self, programs: Programs) -> dict[str, list[str]]:
        """Names of the components of each vector: `STATE_x1`, ..."""
        groups = {
            "STATE": [item.name for item in self.model.states],
            "INPUT": [item.name for item in self.model.inputs],
            "CHANNEL": [item.name for item in self.model.channels],
            "DOSE": [item.state for item in self.model.doses],
            "FUNCTION": [item.label for item in programs.applications],
            "ALGEBRAIC": [item.name for item in self.model.algebraics],
        }
        return {kind: [f"{self.upper}_{kind}_{name}" for name in distinct(names)] for kind, names in groups.items()}
