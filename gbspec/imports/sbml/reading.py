"""An SBML file as libsbml's model, if it is one that can be imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias

import libsbml

from gbspec.imports.description import Report
from gbspec.imports.safety import read_xml, refused

Element: TypeAlias = Any
"""An element of libsbml, which has no types."""
MOST_SHOWN = 20
_SBML = "http://www.sbml.org/sbml/level"
NAMESPACES = {
    **{("1", version): f"{_SBML}1" for version in "12"},
    ("2", "1"): f"{_SBML}2",
    **{("2", version): f"{_SBML}2/version{version}" for version in "2345"},
    **{("3", version): f"{_SBML}3/version{version}/core" for version in "12"},
}
"""The namespace of each level and version."""


def read_model(path: Path, report: Report) -> Element:
    """The document, whose model is read; what is not core SBML is reported. Raises `UserError` (GB894)."""
    data, root = read_xml(path)
    level, version = root.attributes.get("level", ""), root.attributes.get("version", "")
    # Another combination makes libsbml end the whole process.
    if root.name != "sbml" or NAMESPACES.get((level, version)) != root.namespace:
        raise refused(path, f"its root is not that of SBML, or not of Level {level or '?'} Version {version or '?'}")
    document = libsbml.readSBMLFromString(data.decode("utf-8", errors="replace"))
    errors = [document.getError(i) for i in range(document.getNumErrors())]
    severe = [e for e in errors if e.getSeverity() >= libsbml.LIBSBML_SEV_ERROR]
    if document.getModel() is None or document.getLevel() < 1:
        said = severe[0].getShortMessage() if severe else "it holds no model"
        raise refused(path, f"it is no SBML model: {said}", severe[0].getLine() if severe else None)
    for error in severe[:MOST_SHOWN]:
        report.refuse("SBML", error.getLine(), " ".join(error.getMessage().split())[:300])
    if document.getLevel() == 1:
        report.refuse(
            "sbml", document.getLine(), "Level 1 is not offered yet; other programs convert it to Level 2 or 3"
        )
    for i in range(document.getNumPlugins() if document.getLevel() > 2 else 0):
        plugin = document.getPlugin(i)
        _package(report, document, plugin.getPackageName(), plugin.getPrefix())
    if document.getNumUnknownPackages():
        for i in range(document.getNumUnknownPackages()):
            _package(report, document, document.getUnknownPackageURI(i), document.getUnknownPackagePrefix(i))
    return document


def _package(report: Report, document: Element, name: str, prefix: str) -> None:
    """A package of Level 3: refused where it changes what the model means."""
    if name == "l3v2extendedmath":
        return
    if document.getPackageRequired(prefix):
        report.refuse("sbml", document.getLine(), f"the package `{name}` is not offered yet")
    else:
        report.omit("sbml", document.getLine(), f"the package `{name}`, which does not change the solutions")


def omit_notes(report: Report, model: Element) -> None:
    """Reports what describes elements for readers and databases: notes, annotations, terms of ontologies."""
    kinds = (("notes", "isSetNotes"), ("annotations", "isSetAnnotation"), ("terms of ontologies", "isSetSBOTerm"))
    everything = [model, *_all(model)]
    for said, asked in kinds:
        found = [e for e in everything if getattr(e, asked)()]
        if found:
            report.omit(found[0].getElementName(), found[0].getLine(), f"{said} of {len(found)} elements")


def _all(model: Element) -> list[Element]:
    found = model.getListOfAllElements()
    return [found.get(i) for i in range(found.getSize())]
