"""The files of a PEtab problem, as tables of text."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from gbspec.imports.safety import read_file, refused

Row: TypeAlias = dict[str, str]
MOST_YAML = 1_000_000
MOST_TABLE = 20_000_000


@dataclass(frozen=True)
class Tables:
    """A problem's model file and its tables; every row has its place as (file, line)."""

    model: Path
    conditions: list[Row]
    measurements: list[Row]
    observables: list[Row]
    parameters: list[Row]


def read_document(path: Path) -> dict[str, Any]:
    """A problem file. Raises `UserError` (GB894) if it is none."""
    try:
        document: Any = yaml.safe_load(read_file(path, MOST_YAML).decode("utf-8", errors="replace"))
    except (yaml.YAMLError, RecursionError):
        raise refused(path, "it is no YAML") from None
    if not isinstance(document, dict) or "format_version" not in document:
        raise refused(path, "it is no PEtab problem: `format_version` is not in it")
    return document


def version(document: dict[str, Any]) -> str:
    """The number before the first point of a problem's version."""
    return str(document["format_version"]).partition(".")[0]


def read_first(path: Path, document: dict[str, Any]) -> Tables:
    """The tables of a problem of PEtab 1. Raises `UserError` (GB894)."""
    problems = document.get("problems")
    if not isinstance(problems, list) or len(problems) != 1 or not isinstance(problems[0], dict):
        raise refused(path, "it has not exactly one problem")
    one = problems[0]
    models = files_of(path, one.get("sbml_files"))
    if len(models) != 1:
        raise refused(path, "it has not exactly one SBML model")
    parameters = document.get("parameter_file")
    return Tables(
        models[0],
        rows_of(files_of(path, one.get("condition_files"))),
        rows_of(files_of(path, one.get("measurement_files"))),
        rows_of(files_of(path, one.get("observable_files"))),
        rows_of(files_of(path, parameters if isinstance(parameters, list) else [parameters])),
    )


def files_of(path: Path, names: Any) -> list[Path]:
    """Files beside the problem, or below its folder."""
    found = []
    for name in names if isinstance(names, list) else []:
        place = Path(str(name))
        if place.is_absolute() or ".." in place.parts:
            raise refused(path, f"its file `{name}` is not in or below its folder")
        found.append(path.parent / place)
    return found


def rows_of(paths: Iterable[Path]) -> list[Row]:
    """The rows of tables; each knows its place."""
    found = []
    for path in paths:
        text = read_file(path, MOST_TABLE).decode("utf-8", errors="replace").removeprefix("\ufeff")
        try:
            for line, row in enumerate(csv.DictReader(io.StringIO(text), delimiter="\t"), start=2):
                kept = {
                    k.strip(): (v or "").strip()
                    for k, v in row.items()
                    if isinstance(k, str) and not isinstance(v, list)
                }
                if any(kept.values()):
                    found.append({**kept, LINE: str(line), FILE: path.name})
        except csv.Error as error:
            raise refused(path, f"it is no table: {error}") from None
    return found


LINE, FILE = " line", " file"
"""Keys of a row for its place; no column can be named so."""
