"""`modelDescription.xml` of FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal
from xml.etree import ElementTree as Xml

from gbspec.exports.fmi.units import base_unit
from gbspec.exports.fmi.variables import Variable, Variables, units
from gbspec.version import __version__

Version = Literal["2", "3"]
STOP = 10.0
"""The duration of the default experiment."""


def description(variables: Variables, version: Version, identifier: str, token: str, sources: Sequence[str]) -> bytes:
    """The model description of a unit; `sources` are the files to compile."""
    model, exported = variables.model, variables.exported
    root = Xml.Element(
        "fmiModelDescription",
        {
            "fmiVersion": "2.0" if version == "2" else "3.0",
            "modelName": model.name,
            "guid" if version == "2" else "instantiationToken": token,
            "description": model.title or model.name,
            "version": exported.fingerprint[:16],
            "generationTool": f"gbspec {__version__}",
            "variableNamingConvention": "flat",
        },
    )
    if version == "2":
        root.set("numberOfEventIndicators", str(sum(v.indicator for v in variables.all)))
    states = {"canGetAndSetFMU": "true", "canSerializeFMU": "true"}
    word = "state" if version == "2" else "State"
    common = {"modelIdentifier": identifier, **{f"{key}{word}": value for key, value in states.items()}}
    common |= {"providesDirectionalDerivative" + ("s" if version == "3" else ""): "true"}
    kept = {"needsCompletedIntegratorStep": "true"} if version == "3" and model.delays else {}
    exchange = Xml.SubElement(root, "ModelExchange", {**common, **kept})
    together = {"canHandleVariableCommunicationStepSize": "true"}
    together |= {"canInterpolateInputs": "true"} if version == "2" else {}
    together |= {"fixedInternalStepSize": _number(exported.step)} if version == "3" and exported.step else {}
    simulation = Xml.SubElement(root, "CoSimulation", {**common, **together})
    if version == "2":
        for element in (exchange, simulation):
            files = Xml.SubElement(element, "SourceFiles")
            for name in sources:
                Xml.SubElement(files, "File", name=name)
    _units(root, variables.all)
    experiment = {"startTime": _number(exported.start), "stopTime": _number(exported.start + STOP)}
    if version == "3":
        _experiment_and_variables(root, variables, experiment)
    else:
        Xml.SubElement(root, "DefaultExperiment", experiment)
        _variables2(root, variables.all)
    return _written(root)


def _written(root: Xml.Element) -> bytes:
    Xml.indent(root)
    text: bytes = Xml.tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def _units(root: Xml.Element, variables: Sequence[Variable]) -> None:
    named = units(variables)
    if named:
        definitions = Xml.SubElement(root, "UnitDefinitions")
        for name in named:
            unit, based = Xml.SubElement(definitions, "Unit", name=name), base_unit(name)
            if based is not None:
                Xml.SubElement(unit, "BaseUnit", based)


def _number(value: float | None) -> str:
    return repr(float(value or 0.0))


# ------------------------------------------------------------------------------------------------------------- FMI 2.0
def _variables2(root: Xml.Element, variables: Sequence[Variable]) -> None:
    parent = Xml.SubElement(root, "ModelVariables")
    index = {variable.vr: i + 1 for i, variable in enumerate(variables)}
    for one in variables:
        given = {"name": one.name, "valueReference": str(one.vr), "causality": one.causality}
        given |= {"variability": one.variability} | ({"initial": one.initial} if one.initial else {})
        given |= {"description": one.description} if one.description else {}
        element = Xml.SubElement(parent, "ScalarVariable", given)
        kind = Xml.SubElement(element, "Boolean" if one.boolean else "Real")
        if one.start is not None:
            kind.set("start", _number(one.start))
        if one.unit:
            kind.set("unit", one.unit)
        if one.derivative_of is not None:
            kind.set("derivative", str(index[one.derivative_of]))
    structure = Xml.SubElement(root, "ModelStructure")
    groups = (
        ("Outputs", [v for v in variables if v.causality == "output"], False),
        ("Derivatives", [v for v in variables if v.derivative_of is not None], False),
        ("InitialUnknowns", [v for v in variables if v.initially is not None], True),
    )
    for name, members, initially in groups:
        if not members:
            continue
        group = Xml.SubElement(structure, name)
        for one in members:
            on = (one.initially if initially else one.depends) or ()
            listed = " ".join(str(index[vr]) for vr in on)
            Xml.SubElement(group, "Unknown", index=str(index[one.vr]), dependencies=listed)


# ------------------------------------------------------------------------------------------------------------- FMI 3.0
def _experiment_and_variables(root: Xml.Element, variables: Variables, experiment: dict[str, str]) -> None:
    Xml.SubElement(root, "DefaultExperiment", experiment)
    parent = Xml.SubElement(root, "ModelVariables")
    for one in variables.all:
        given = {"name": one.name, "valueReference": str(one.vr), "causality": one.causality}
        given |= {"variability": one.variability} | ({"initial": one.initial} if one.initial else {})
        given |= {"description": one.description} if one.description else {}
        given |= {"unit": one.unit} if one.unit else {}
        given |= {"derivative": str(one.derivative_of)} if one.derivative_of is not None else {}
        given |= {"start": _number(one.start)} if one.start is not None else {}
        Xml.SubElement(parent, "Boolean" if one.boolean else "Float64", given)
    structure = Xml.SubElement(root, "ModelStructure")
    groups = (
        ("Output", [v for v in variables.all if v.causality == "output"], False),
        ("ContinuousStateDerivative", [v for v in variables.all if v.derivative_of is not None], False),
        ("InitialUnknown", [v for v in variables.all if v.initially is not None], True),
        ("EventIndicator", [v for v in variables.all if v.indicator], False),
    )
    for name, members, initially in groups:
        for one in members:
            on = (one.initially if initially else one.depends) or ()
            listed = " ".join(map(str, on))
            Xml.SubElement(structure, name, valueReference=str(one.vr), dependencies=listed)


def build_description(identifier: str, sources: Sequence[str]) -> bytes:
    """`sources/buildDescription.xml` of FMI 3.0."""
    root = Xml.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = Xml.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = Xml.SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        Xml.SubElement(files, "SourceFile", name=name)
    Xml.SubElement(configuration, "Library", name="m")
    return _written(root)
