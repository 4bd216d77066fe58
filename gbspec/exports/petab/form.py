"""The form `petab`: a folder with a PEtab 2 problem."""

from __future__ import annotations

import re

import yaml

from gbspec.backends import NotCoveredError
from gbspec.data import Trajectories
from gbspec.exports.example import Example
from gbspec.exports.made import ExportOptions, Made, record
from gbspec.exports.petab.courses import Courses, Lines
from gbspec.exports.petab.tables import Observed, experiments, parameters
from gbspec.exports.sbml import Document, remarks
from gbspec.exports.subject import Exported

PROBLEM = "problem.yaml"


def make(exported: Exported, example: Example, options: ExportOptions) -> Made:
    """The files of a problem: the model, and the tables that its data make."""
    data, starts = options.data, options.starts
    assert data is not None
    assert starts is not None
    model = exported.model
    if any(one.per_trajectory for one in model.learnables):
        raise NotCoveredError("it has constants of single trajectories (`per trajectory`), which is not offered yet")
    document = Document(exported)
    lines = _lines(document)
    courses = Courses(document, lines, starts)
    made = [courses.course(name, i, item) for i, (name, item) in enumerate(zip(_labels(data), data.items, strict=True))]
    observed = Observed(document, data, lines)
    files = {
        PROBLEM: _problem(document).encode(),
        "observables.tsv": observed.observables(),
        "measurements.tsv": observed.measurements(made),
        "parameters.tsv": parameters(document, model.learnables),
        **experiments(made),
    }
    files["model.xml"] = document.text().encode()
    files |= {"model.gb": model.text.encode(), "export.json": record(exported, "petab")}
    return Made(files, remarks=tuple(remarks(document)))


def _labels(data: Trajectories) -> list[str]:
    """Names of experiments, which are identifiers: each as the trajectory, if that is one."""
    found: list[str] = []
    for item in data.items:
        name = re.sub(r"\W", "_", item.label, flags=re.ASCII)
        name = name if name[:1].isalpha() else f"e_{name}"
        while name in found:
            name += "_"
        found.append(name)
    return found


def _lines(document: Document) -> dict[str, Lines]:
    """The quantities of inputs that are linear between their times."""
    found = {}
    for given in document.source.inputs:
        if given.interpolation != "linear":
            continue
        own = Lines(*(document.names.free(f"{given.name}_{word}") for word in ("height", "slope", "since")))
        for name in (own.height, own.slope, own.since):
            document.quantity(name, "", None, value=0.0)
        rule = document.model.createAssignmentRule()
        rule.setVariable(document.names(given.name))
        rule.setMath(document.math(f"{own.height} + {own.slope}*(time - {own.since})"))
        found[given.name] = own
    return found


def _problem(document: Document) -> str:
    made = {
        "format_version": "2.0.0",
        "model_files": {document.model.getId(): {"language": "sbml", "location": "model.xml"}},
        **{
            f"{word}_files": [f"{word}s.tsv"]
            for word in ("condition", "experiment", "measurement", "observable", "parameter")
        },
    }
    return str(yaml.safe_dump(made, sort_keys=False))
