"""The form `sbml`: one file, or a folder with the model's text beside it."""

from __future__ import annotations

from gbspec.diagnostics import Diagnostic, Severity
from gbspec.exports.example import Example
from gbspec.exports.made import ExportOptions, Made, record
from gbspec.exports.sbml.document import Document
from gbspec.exports.subject import Exported


def make(exported: Exported, example: Example, options: ExportOptions) -> Made:
    """The files of a model."""
    document = Document(exported)
    document.channels()
    said = remarks(document)
    if exported.model.inputs:
        names = ", ".join(f"`{item.name}`" for item in exported.model.inputs)
        said.append(_left_out(f"the course of {names} over time: an SBML document has one value of each"))
    if exported.model.doses:
        said.append(_left_out("doses: they are in tables; `--as petab --data TABLE` has them"))
    if exported.model.steady is not None:
        said.append(_left_out("the steady start: the states begin where it is sought; `--as petab` has it"))
    files = {f"{exported.model.name}.xml": document.text().encode()}
    files |= {"model.gb": exported.model.text.encode(), "export.json": record(exported, "sbml")}
    return Made(files, remarks=tuple(said))


def remarks(document: Document) -> list[Diagnostic]:
    """What every document leaves out."""
    said = []
    if document.units.left_out:
        said.append(_left_out(f"the units {', '.join(map(repr, document.units.left_out))}, which SBML cannot state"))
    return said


def _left_out(what: str) -> Diagnostic:
    return Diagnostic("GB890", f"SBML does not have {what}", None, severity=Severity.WARNING)
