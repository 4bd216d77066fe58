"""What an imported model is, before it is written: the declarations of a `.gb` file, and what could not be carried
over. Every importer makes one; `writing` makes the text of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from gbspec.diagnostics import Cell, Diagnostic, UserError
from gbspec.imports.formulas import ZERO, Formula


@dataclass(frozen=True)
class LeftOut:
    """Something that was not carried over: the element and its line in the file, and the reason."""

    element: str
    line: int
    reason: str


@dataclass(frozen=True)
class Quantity:
    """A constant, an intermediate, or a state with its start and its balance; `learn` are the clauses of a constant
    that is learned, after its value.

    `unit` is a text of the language; `range` are the bounds of a constant that is learned. A constant that follows a
    table (`condition`) has its default as the value. Only events change a state that is `discrete`.
    """

    id: str
    value: Formula | None = None
    description: str = ""
    unit: str | None = None
    learn: str | None = None
    range: tuple[float, float] | None = None
    condition: bool = False
    discrete: bool = False


@dataclass(frozen=True)
class Function:
    """A known function."""

    id: str
    arguments: tuple[str, ...]
    value: Formula
    description: str = ""


@dataclass(frozen=True)
class Conversion:
    """A reaction as a process: coefficients and states on both sides, and the rate."""

    id: str
    consumed: tuple[tuple[Formula, str], ...]
    produced: tuple[tuple[Formula, str], ...]
    rate: Formula
    description: str = ""


@dataclass(frozen=True)
class Event:
    """What happens when a condition becomes true: states and their values, computed from those before.

    `after` is a delay. `sampled`: the values are those of the time when the condition became true; `transient`: it is
    given up when the condition ends; `queue`: how many can wait."""

    id: str
    condition: Formula
    values: tuple[tuple[str, Formula], ...]
    priority: Formula = ZERO
    armed: bool = False
    after: Formula | None = None
    sampled: bool = False
    transient: bool = False
    queue: int = 1
    description: str = ""
    at: Formula | None = None
    """The time, if the condition is that it has come."""


@dataclass(frozen=True)
class Rest:
    """A start in a steady state: what inputs and conditions are meanwhile, what states are set to then, and the
    condition of the trajectories that start so (None: all)."""

    held: tuple[tuple[str, Formula], ...] = ()
    after: tuple[tuple[str, Formula], ...] = ()
    when: Formula | None = None


@dataclass(frozen=True)
class Channel:
    """What is observed: an expression, in a column, with its noise: `normal` or `lognormal`, and the argument."""

    id: str
    value: Formula
    column: str
    noise: tuple[str, Formula] | None = None


@dataclass
class Description:
    """An imported model. Names are those of the source; `writing` spells them as the language allows."""

    name: str
    title: str = ""
    source: str = ""
    time_unit: str | None = None
    units: dict[str, str] = field(default_factory=dict)
    """Units of the model's own, with their descriptions."""
    constants: list[Quantity] = field(default_factory=list)
    states: list[Quantity] = field(default_factory=list)
    """`value` is the start."""
    intermediates: list[Quantity] = field(default_factory=list)
    functions: list[Function] = field(default_factory=list)
    conversions: list[Conversion] = field(default_factory=list)
    balances: dict[str, Formula] = field(default_factory=dict)
    """The right side of each state with a balance, without `net`, which is added where it has conversions too."""
    rest: Rest | None = None
    events: list[Event] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)


@dataclass
class Report:
    """What an import could not carry over, and what makes it impossible."""

    path: str
    left_out: list[LeftOut] = field(default_factory=list)
    reasons: dict[tuple[str, int, str], None] = field(default_factory=dict)
    """Element, line and reason of each construct that the language cannot express, in order."""

    def omit(self, element: str, line: int, reason: str) -> None:
        """Something that does not change the solutions is left out."""
        self.left_out.append(LeftOut(element, line, reason))

    def refuse(self, element: str, line: int, reason: str) -> None:
        """Something cannot be expressed, so that the whole import is refused."""
        self.reasons.setdefault((element, line, reason))

    def raise_if_refused(self) -> None:
        """Raises `UserError` (GB895) with all reasons."""
        if self.reasons:
            raise UserError(
                Diagnostic("GB895", f"{element}: {reason}", Cell(self.path, line or None), help=_HELP)
                for element, line, reason in self.reasons
            )


_HELP = (
    "nothing is written, since solutions or their likelihood would be others; "
    "docs/howto/import.md lists what can be imported"
)


@dataclass(frozen=True)
class Imported:
    """A description with what it left out, the files that stand beside the model, by name, and the options of training
    by which a fit has the objective of the source."""

    description: Description
    left_out: tuple[LeftOut, ...]
    files: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)
