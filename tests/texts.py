"""From a text to what the front end makes of it, for tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import gbspec
from gbspec.diagnostics import Findings, Source
from gbspec.ir.model import Model
from gbspec.ir.verification import verify
from gbspec.lower import lower
from gbspec.semantics import Checked, check
from gbspec.syntax.parser import parse, read_source

ROOT = Path(gbspec.__file__).parent.parent
SHIPPED = sorted((ROOT / "models").glob("*/*.gb"))


def loader(files: Mapping[str, str]):  # type: ignore[no-untyped-def] # a closure of one argument
    """Reads files that exist only here, by their names."""

    def load(path: Path) -> Source:
        if path.name not in files:
            raise FileNotFoundError(path)
        return Source(str(path), files[path.name])

    return load


def checked(text: str, files: Mapping[str, str] | None = None) -> tuple[Checked | None, Findings]:
    """What semantics makes of a text, and everything found."""
    findings = Findings()
    file = parse(Source("here/main.gb", text), findings)
    assert file is not None
    return check(file, findings, loader(files or {})), findings


def codes(text: str, files: Mapping[str, str] | None = None) -> list[str]:
    """The codes of all findings, in the order of the text."""
    return [d.code for d in checked(text, files)[1]]


def model_of(text: str, files: Mapping[str, str] | None = None) -> Model:
    """The verified Model of a text that is right (warnings aside)."""
    result, findings = checked(text, files)
    assert result is not None, [d.message for d in findings.errors]
    model = lower(result, findings)
    assert not findings.failed, [d.message for d in findings.errors]
    verify(model)
    return model


def model_at(path: Path) -> Model:
    """The verified Model of a file."""
    findings = Findings()
    file = parse(read_source(path), findings)
    assert file is not None
    result = check(file, findings, read_source)
    assert result is not None, [d.message for d in findings.errors]
    model = lower(result, findings)
    verify(model)
    return model
