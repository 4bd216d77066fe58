"""Diagnostics and exceptions: data about errors, independent of their rendering."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import Enum

from gbspec.diagnostics.span import Cell, Place, Span


class Severity(Enum):
    """Errors stop a command (exit status 1); warnings do not, except with `--strict`."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class Label:
    """Another place of a diagnostic, with a short text on its role."""

    span: Span
    text: str


@dataclass(frozen=True)
class Diagnostic:
    """One error or warning: a code of the catalogue, a message, the place, and a remedy.

    `subject` is the name with which `allow CODE NAME` accepts it.
    """

    code: str
    message: str
    place: Place
    label: str = ""
    labels: tuple[Label, ...] = ()
    notes: tuple[str, ...] = ()
    help: str = ""
    subject: str | None = None
    severity: Severity = field(default=Severity.ERROR)

    def sort_key(self) -> tuple[str, int, int, str]:
        """The key that sorts diagnostics by place in the text (in tables by row), errors and warnings together."""
        match self.place:
            case Span(source=source, start=start, end=end):
                return source.path, start, end, self.code
            case Cell(path=path, row=row):
                return path, row or 0, 0, self.code
            case None:
                return "", 0, 0, self.code


class Findings:
    """Collects diagnostics while a stage runs; every stage reports all of its diagnostics before it stops."""

    def __init__(self, initial: Iterable[Diagnostic] = ()) -> None:
        self._items: dict[Diagnostic, None] = dict.fromkeys(initial)

    def error(
        self,
        code: str,
        message: str,
        place: Place,
        *,
        label: str = "",
        labels: Iterable[Label] = (),
        notes: Iterable[str] = (),
        help: str = "",
        subject: str | None = None,
    ) -> None:
        """Records an error."""
        self.add(Diagnostic(code, message, place, label, tuple(labels), tuple(notes), help, subject, Severity.ERROR))

    def warning(
        self,
        code: str,
        message: str,
        place: Place,
        *,
        label: str = "",
        labels: Iterable[Label] = (),
        notes: Iterable[str] = (),
        help: str = "",
        subject: str | None = None,
    ) -> None:
        """Records a warning."""
        self.add(Diagnostic(code, message, place, label, tuple(labels), tuple(notes), help, subject, Severity.WARNING))

    def add(self, diagnostic: Diagnostic) -> None:
        """Records a diagnostic, unless it is recorded already."""
        self._items.setdefault(diagnostic)

    def extend(self, diagnostics: Iterable[Diagnostic]) -> None:
        """Records several."""
        for diagnostic in diagnostics:
            self.add(diagnostic)

    def __iter__(self) -> Iterator[Diagnostic]:
        return iter(sorted(self._items, key=Diagnostic.sort_key))

    def __len__(self) -> int:
        return len(self._items)

    @property
    def errors(self) -> list[Diagnostic]:
        """The errors, in the order of the text."""
        return [d for d in self if d.severity is Severity.ERROR]

    @property
    def failed(self) -> bool:
        """Whether any error was recorded."""
        return any(d.severity is Severity.ERROR for d in self._items)

    def raise_if_failed(self) -> None:
        """Raises `UserError` with all diagnostics (warnings too) if there is an error."""
        if self.failed:
            raise UserError(tuple(self))


class UserError(Exception):
    """The user's input is wrong (exit status 1). `diagnostics` has all errors and warnings."""

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        self.diagnostics = tuple(diagnostics)
        super().__init__("; ".join(f"{d.code}: {d.message}" for d in self.diagnostics))

    def __reduce__(self) -> tuple[type[UserError], tuple[tuple[Diagnostic, ...]]]:
        """Pickles the diagnostics, so that worker processes can raise it; by default only the text is pickled."""
        return UserError, (self.diagnostics,)


class ComputationError(Exception):
    """A computation failed (exit status 3): which, where, and a remedy."""

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what, self.where, self.remedy = what, where, remedy
        super().__init__(what)


class Defect(Exception):  # noqa: N818 - the name distinguishes a defect of gbspec (exit status 70)
    """A bug in gbspec (exit status 70), whatever the user's input."""
