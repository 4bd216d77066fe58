"""The options of a study: a frozen dataclass from which flags and help are derived."""

from __future__ import annotations

from dataclasses import dataclass, field

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.given import is_real, is_whole, plain, shown
from gbspec.training import Effort


@dataclass(frozen=True)
class StudyOptions:
    """How `gbspec study` fits the cases; an option that is None is taken from the case."""

    case: tuple[str, ...] = field(
        default=(), metadata={"help": "A case to fit (repeatable); default: all of CASES.", "metavar": "CASE"}
    )
    members: int | None = field(
        default=None,
        metadata={"help": "Fits of each case, each with its own data and weights; default: as in the case, else 10."},
    )
    seed: int = field(default=0, metadata={"help": "Seed of the first member; member K uses SEED + K."})
    effort: Effort | None = field(default=None, metadata={"help": "Effort of every case; default: as in the case."})
    noise: float | None = field(
        default=None, metadata={"help": "Noise of simulated data, relative to each channel; default: as in the case."}
    )
    workers: int = field(default=1, metadata={"help": "Number of processes that fit members in parallel."})
    threads: int = field(default=1, metadata={"help": "Threads of each worker."})
    keep_runs: bool = field(default=False, metadata={"help": "Keep each member's run directory and table."})
    table_only: bool = field(
        default=False, metadata={"help": "Fit nothing: write the tables of what has been fitted so far."}
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", plain(self.noise))

    def flags(self) -> list[str]:
        """The options on which the results depend, as given on the command line."""
        given: list[tuple[str, object]] = [("--case", case) for case in self.case]
        given += [(f"--{name}", getattr(self, name)) for name in ("members", "effort", "noise")]
        given.append(("--seed", self.seed or None))
        return [str(part) for flag in given if flag[1] is not None for part in flag]

    def check(self) -> None:
        """Raises `UserError` (GB814) with every invalid value."""
        wrong = [
            ("members", self.members, self.members is None or _count(self.members), "a whole number, at least 1"),
            ("seed", self.seed, is_whole(self.seed) and self.seed >= 0, "a whole number, zero or more"),
            ("noise", self.noise, self.noise is None or _size(self.noise), "a number, zero or more"),
            ("workers", self.workers, _count(self.workers), "a whole number, at least 1"),
            ("threads", self.threads, _count(self.threads), "a whole number, at least 1"),
        ]
        found = [
            Diagnostic("GB814", f"`--{name} {shown(value)}` must be {expected}", None)
            for name, value, holds, expected in wrong
            if not holds
        ]
        if found:
            raise UserError(found)


def _count(value: object) -> bool:
    return is_whole(value) and value >= 1


def _size(value: object) -> bool:
    return is_real(value) and 0 <= value < float("inf")
