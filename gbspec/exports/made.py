"""What an export consists of, what it was asked for, and how a form is registered."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:  # the command line lists the forms, and needs neither models nor numbers for that
    from gbspec.arrays import Array
    from gbspec.data import Trajectories
    from gbspec.diagnostics import Diagnostic
    from gbspec.exports.checking import Quantity
    from gbspec.exports.example import Example
    from gbspec.exports.subject import Exported

Precision = Literal["float64", "float32"]
Shape = Literal["folder", "file"]


@dataclass(frozen=True)
class ExportOptions:
    """`verify`: compare with the generated module; `precision` and `part` are those of ONNX graphs; `data` and the
    `starts` [N, n] of its trajectories, as far as the model does not give them, are those of PEtab problems."""

    verify: bool = True
    precision: Precision = "float64"
    part: str | None = None
    data: Trajectories | None = None
    starts: Array | None = None


@dataclass(frozen=True)
class Made:
    """The files of an export by name, the quantities that were compared, and remarks (warnings)."""

    files: Mapping[str, bytes]
    checked: tuple[Quantity, ...] = ()
    remarks: tuple[Diagnostic, ...] = ()


@dataclass(frozen=True)
class Form:
    """A form of an export: what it is called after `--as`, a line of help, and a function that makes its files.

    `packed`: the files are one archive with the target's name, whatever its suffix; else an archive only for `.zip`.
    """

    name: str
    help: str
    make: Callable[[Exported, Example, ExportOptions], Made]
    packed: bool = field(default=False, kw_only=True)
    single: str = field(default="", kw_only=True)
    """The suffix of a path that gets one part alone."""
    simulates: bool = field(default=False, kw_only=True)
    """Whether it has a program that simulates the example."""
    tabled: bool = field(default=False, kw_only=True)
    """Whether it needs a table of measurements."""


def record(exported: Exported, form: str) -> bytes:
    """The content of `export.json`."""
    return (json.dumps({"form": form, **exported.origin}, indent=2, ensure_ascii=False) + "\n").encode()
