"""Small SBML files, written from parts."""

from __future__ import annotations

from pathlib import Path

CORE = 'xmlns="http://www.sbml.org/sbml/level3/version2/core" level="3" version="2"'
MATH = 'xmlns="http://www.w3.org/1998/Math/MathML"'


def sbml(*parts: str, attributes: str = "") -> str:
    """A model with these lists."""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<sbml {CORE}>\n<model id="made"{attributes}>\n'
        + "\n".join(parts)
        + "\n</model>\n</sbml>\n"
    )


def math(body: str) -> str:
    """A formula in MathML."""
    return f"<math {MATH}>{body}</math>"


def apply(operator: str, *parts: str) -> str:
    """An operator applied to names and numbers."""
    found = [p if p.startswith("<") else f"<cn>{p}</cn>" if p[0].isdigit() else f"<ci>{p}</ci>" for p in parts]
    return f"<apply><{operator}/>{''.join(found)}</apply>"


def compartments(size: str = "1", constant: str = "true") -> str:
    """One compartment, `C`."""
    return (
        "<listOfCompartments>"
        f'<compartment id="C" spatialDimensions="3" size="{size}" constant="{constant}"/></listOfCompartments>'
    )


def species(*names: str, amount: str = "1", boundary: str = "false", more: str = "") -> str:
    """Species with an amount at the start."""
    each = "".join(
        f'<species id="{name}" compartment="C" initialAmount="{amount}" hasOnlySubstanceUnits="false" '
        f'boundaryCondition="{boundary}" constant="false"{more}/>'
        for name in names
    )
    return f"<listOfSpecies>{each}</listOfSpecies>"


def parameters(constant: str = "true", **values: str) -> str:
    """Parameters by name."""
    each = "".join(f'<parameter id="{k}" value="{v}" constant="{constant}"/>' for k, v in values.items())
    return f"<listOfParameters>{each}</listOfParameters>"


def reaction(name: str, reactants: str, products: str, law: str) -> str:
    """A reaction with unit coefficients, in its list."""
    sides = ""
    for kind, given in (("Reactants", reactants), ("Products", products)):
        each = "".join(f'<speciesReference species="{s}" stoichiometry="1" constant="true"/>' for s in given.split())
        sides += f"<listOf{kind}>{each}</listOf{kind}>" if each else ""
    return (
        f'<listOfReactions><reaction id="{name}" reversible="false">{sides}'
        f"<kineticLaw>{math(law)}</kineticLaw></reaction></listOfReactions>"
    )


def rules(**rates: str) -> str:
    """Rate rules by name."""
    each = "".join(f'<rateRule variable="{name}">{math(body)}</rateRule>' for name, body in rates.items())
    return f"<listOfRules>{each}</listOfRules>"


def event(
    name: str, trigger: str, values: dict[str, str], inside: str = "", initial: str = "true", persistent: str = "true"
) -> str:
    """An event; events stand in `happening`."""
    each = "".join(f'<eventAssignment variable="{k}">{math(v)}</eventAssignment>' for k, v in values.items())
    return (
        f'<event id="{name}" useValuesFromTriggerTime="true">'
        f'<trigger initialValue="{initial}" persistent="{persistent}">'
        f"{math(trigger)}</trigger>{inside}<listOfEventAssignments>{each}</listOfEventAssignments></event>"
    )


def happening(*events: str) -> str:
    """The list of events."""
    return f"<listOfEvents>{''.join(events)}</listOfEvents>"


def stored(folder: Path, text: str, name: str = "made.xml") -> Path:
    """The file of a text."""
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name
