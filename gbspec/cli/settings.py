"""Texts of flags that name values: `--set NAME=VALUE` and `--at "NAME=VALUE,NAME=VALUE"`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Annotated

import typer

from gbspec.data import BY_NUMBER
from gbspec.diagnostics import Findings

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="Another value for a constant, learnable or condition (a category by its number, from 0).",
        metavar="NAME=VALUE",
    ),
]
"""The parameter `--set` of the commands that have it."""
Form = Annotated[
    str,
    typer.Option(
        "--format",
        help="How the table is written: auto (by its columns), table, nonmem, or nonmem:1=gut,2=conc (compartments).",
        metavar="FORM",
    ),
]
"""The parameter `--format` of the commands that read a table."""


def settings(texts: Sequence[str] | None) -> dict[str, float]:
    """`NAME=VALUE` texts as a mapping. Raises `UserError` (GB810) with everything that is malformed or repeated."""
    findings = Findings()
    values = assignments(texts or (), "--set", "GB810", findings, f"write a name and a number: --set B=14; {BY_NUMBER}")
    findings.raise_if_failed()
    return values


def points(texts: Sequence[str] | None) -> tuple[dict[str, float], ...]:
    """`NAME=VALUE,NAME=VALUE` texts, one mapping each. Raises `UserError` (GB810)."""
    findings = Findings()
    help = f'write names and numbers: --at "x1=0.4,x2=1.2"; {BY_NUMBER}'
    found = [assignments(text.split(","), "--at", "GB810", findings, help) for text in texts or ()]
    findings.raise_if_failed()
    return tuple(found)


def assignments(texts: Iterable[str], flag: str, code: str, findings: Findings, help: str) -> dict[str, float]:
    """The assignments that are well formed; the others are recorded under `code`."""
    values: dict[str, float] = {}
    for text in texts:
        name, equals, given = (part.strip() for part in text.partition("="))
        value = _number(given)
        if not (name and equals) or value is None:
            findings.error(code, f"`{flag} {text.strip()}` is not a name and a number", None, help=help)
        elif name in values:
            findings.error(code, f"`{flag}` gives `{name}` twice", None, help="give it once")
        else:
            values[name] = value
    return values


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
