"""The form `petab`: a folder with a PEtab 2 problem."""

from __future__ import annotations

import re
from collections.abc import Sequence

import yaml

from gbspec.backends import NotCoveredError
from gbspec.data import Trajectories
from gbspec.exports.example import Example
from gbspec.exports.made import ExportOptions, Made, record
from gbspec.exports.petab.courses import Courses, Lines
from gbspec.exports.petab.networks import AgainError, Hybrid, Networks, extension, weights
from gbspec.exports.petab.networks import files as network_files
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
    document, networks = _document(exported)
    lines = _lines(document)
    courses = Courses(document, lines, starts)
    made = [courses.course(name, i, item) for i, (name, item) in enumerate(zip(_labels(data), data.items, strict=True))]
    observed = Observed(document, data, lines)
    files = {
        PROBLEM: b"",
        "observables.tsv": observed.observables(),
        "measurements.tsv": observed.measurements(made),
        **experiments(made),
    }
    hybrid = list(networks.found.values())  # complete, now that all formulas are written
    for one in hybrid:
        for name in one.outputs:
            document.quantity(name, "", None, value=0.0, constant=True)
    files["parameters.tsv"] = parameters(document, model.learnables, weights(hybrid))
    files[PROBLEM] = _problem(document, hybrid).encode()
    files |= network_files(hybrid)
    files["model.xml"] = document.text().encode()
    files |= {"model.gb": model.text.encode(), "export.json": record(exported, "petab")}
    return Made(files, remarks=tuple(remarks(document)))


def _document(exported: Exported) -> tuple[Document, Networks]:
    """The model's document, and its networks; those that are applied twice are in formulas."""
    formulas: frozenset[int] = frozenset()
    while True:
        try:
            document = Document(exported, lambda e, names: Networks(e, names, formulas))  # noqa: B023 - called here
            for channel in exported.model.channels:
                document.infix(channel.value)
        except AgainError as problem:
            formulas |= {problem.network}
            continue
        assert isinstance(document.applications, Networks)
        return document, document.applications


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


def _problem(document: Document, networks: Sequence[Hybrid]) -> str:
    made = {
        "format_version": "2.0.0",
        "model_files": {document.model.getId(): {"language": "sbml", "location": "model.xml"}},
        **{
            f"{word}_files": [f"{word}s.tsv"]
            for word in ("condition", "experiment", "measurement", "observable", "parameter")
        },
        **extension(networks),
    }
    return str(yaml.safe_dump(made, sort_keys=False))
