"""The forms in which a table may be written: an ordinary one, or that of NONMEM, with what its compartments mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from gbspec.data.names import similar
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Model

KINDS = ("auto", "table", "nonmem")
HELP = "write `auto`, `table`, `nonmem`, or `nonmem:1=gut,2=conc` to say what compartments mean"


@dataclass(frozen=True)
class Format:
    """The form of a table; `auto`: recognised by its columns. `compartments` are names of states and channels by the
    numbers that stand for them; `text` is the form as it was given."""

    kind: str = "auto"
    compartments: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))
    text: str = "auto"

    def check(self, model: Model) -> None:
        """Raises `UserError` (GB759) if a compartment is neither a dosed state nor a channel."""
        known = [*(dose.state for dose in model.doses), *(channel.name for channel in model.channels)]
        for number, name in self.compartments.items():
            if name not in known:
                meant = similar(name, known)
                help = f"is `{meant}` meant?" if meant else f"there are {', '.join(known) or 'none'}"
                message = f"`--format`: compartment {number} is `{name}`, which is neither a dosed state nor a channel"
                raise UserError([Diagnostic("GB759", message, None, help=help)])

    def doses(self, model: Model) -> dict[int, int]:
        """The doses, by index, of the compartments that have a name."""
        place = {dose.state: i for i, dose in enumerate(model.doses)}
        return {number: place[name] for number, name in self.compartments.items() if name in place}

    def channels(self, model: Model) -> dict[int, int]:
        """The channels, by index, of the compartments that have a name."""
        place = {channel.name: i for i, channel in enumerate(model.channels)}
        return {number: place[name] for number, name in self.compartments.items() if name in place}


def format_named(text: str) -> Format:
    """The form that a text names: `auto`, `table`, `nonmem`, `nonmem:1=gut,2=conc`. Raises `UserError` (GB759)."""
    kind, colon, rest = text.strip().partition(":")
    compartments: dict[int, str] = {}
    wrong = kind not in KINDS or (bool(colon) and kind != "nonmem")
    for part in rest.split(",") if colon and not wrong else ():
        number, equals, name = (piece.strip() for piece in part.partition("="))
        if not (equals and name and number.isdigit()):
            wrong = True
            break
        compartments[int(number)] = name
    if wrong:
        raise UserError([Diagnostic("GB759", f"`--format {text}` is no form of a table", None, help=HELP)])
    return Format(kind, MappingProxyType(compartments), text.strip())
