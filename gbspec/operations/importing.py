"""Imports of models of other formats into a folder: the `.gb` file, its table and options, and what was left out."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec import frontend
from gbspec.diagnostics import Cell, Diagnostic, Findings, Source, UserError, packages
from gbspec.files import writable, write_text

if TYPE_CHECKING:
    from gbspec.imports import Imported, LeftOut, Written

MARK = "by gbspec import"
"""In the second line of every model that an import wrote, which another import may replace."""
LEFT_OUT = "left_out.csv"


@dataclass(frozen=True)
class Import:
    """What was written: the model's path, that of its table if there is one, and what was left out; `options` are those
    of training by which a fit has the objective of the source."""

    name: str
    model: str
    data: str | None
    options: Mapping[str, str]
    left_out: tuple[LeftOut, ...]

    def to_json(self) -> dict[str, object]:
        """The content of `import --json`."""
        return {
            "model": self.model,
            "data": self.data,
            "options": dict(self.options),
            "left_out": [asdict(one) for one in self.left_out],
        }


def importers() -> Mapping[str, Callable[[Path], Imported]]:
    """The readers by the ending of a file's name."""
    from gbspec.imports import import_petab, import_sbml

    return {".xml": import_sbml, ".sbml": import_sbml, ".yaml": import_petab, ".yml": import_petab}


@packages()
def import_file(path: str | Path, directory: str | Path) -> Import:
    """Imports a file into a folder.

    Raises `UserError`: GB894 if the file is not read, GB895 with all reasons if it cannot be expressed, GB896 if its
    name is of no known format, GB897 if the folder has a model of the same name that no import wrote.
    """
    source = Path(path)
    known = importers()
    if source.suffix.lower() not in known:
        message = f"`{source}` is of no format that is imported"
        help = "SBML files end in `.xml` or `.sbml`, PEtab problems in `.yaml`"
        raise UserError([Diagnostic("GB896", message, Cell(str(source)), help=help)])
    made = known[source.suffix.lower()](source)
    folder = Path(directory)
    target = folder / f"{made.description.name}.gb"
    _free(target)
    text, left_out = _checked(made, target, str(source))
    folder.mkdir(parents=True, exist_ok=True)
    write_text(writable(target), text.text)
    for name, content in made.files.items():
        write_text(folder / name, content)
    write_text(folder / LEFT_OUT, _table(left_out))
    kept = {name: str(folder / name) for name in made.files}
    data = next((path for name, path in kept.items() if name.endswith(".csv")), None)
    return Import(made.description.name, str(target), data, made.options, left_out)


def _free(target: Path) -> None:
    """Raises `UserError` (GB897) if a model of somebody stands there."""
    if target.exists() and not (
        target.is_file() and MARK in target.read_text(encoding="utf-8", errors="replace")[:2000]
    ):
        message = f"`{target}` exists, and no import wrote it"
        raise UserError([Diagnostic("GB897", message, Cell(str(target)), help="name another folder: `-o DIR`")])


def _checked(made: Imported, target: Path, path: str) -> tuple[Written, tuple[LeftOut, ...]]:
    """The text, which the compiler has read; without units if they do not agree. Raises `UserError` (GB895)."""
    from gbspec.imports import LeftOut, written

    with_units = written(made.description)
    findings = _findings(with_units.text, target)
    if not findings:
        return with_units, made.left_out
    without = written(made.description, units=False)
    others = _findings(without.text, target)
    if not others and without.text != with_units.text:
        reason = f"all units: the language found that they do not agree ({findings[0].message})"
        return without, (*made.left_out, LeftOut("units", 0, reason))
    raise UserError(
        Diagnostic("GB895", f"the language cannot express it: {one.message}", Cell(path), help=one.help or "")
        for one in others
    )


def _findings(text: str, target: Path) -> list[Diagnostic]:
    """The errors of a model's text."""
    source = Source(str(target), text)
    findings = Findings()
    try:
        frontend.load_model(source.path, findings, lambda _: source)
    except UserError as error:
        return [one for one in error.diagnostics if one.severity.value == "error"]
    return []


def _table(left_out: tuple[LeftOut, ...]) -> str:
    """The list as a table of text."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["element", "line", "reason"])
    writer.writerows([one.element, one.line or "", one.reason] for one in left_out)
    return out.getvalue()
