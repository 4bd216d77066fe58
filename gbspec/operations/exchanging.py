"""Exports in forms that are imported too, checked by importing them again: equal equations, and equal likelihoods."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gbspec import frontend
from gbspec.diagnostics import ComputationError, Diagnostic, Findings, Severity, UserError
from gbspec.operations import evaluating, importing, tables
from gbspec.operations.models import Subject, reference

if TYPE_CHECKING:
    from gbspec.exports import Exported, ExportOptions, Made

FORMS = ("petab", "sbml")
POINTS = 5
MOST_UNITS = 12
"""The number of hidden units up to which networks are imported again."""
SLOPES, LIKELIHOOD = 1e-9, 1e-8
"""The largest errors that are accepted, relative to the sizes of what is compared."""


def checked(source: Subject, exported: Exported, form: str, made: Made, options: ExportOptions) -> Made:
    """The export with what was compared after it was imported again; with a warning (GB892) where that is refused.

    Raises ComputationError where it differs."""
    from gbspec.exports import Quantity, require

    if sum(sum(network.hidden) for network in source.model.networks) > MOST_UNITS:
        reason = f"an import of networks of more than {MOST_UNITS} units as formulas takes too long"
        return replace(made, remarks=(*made.remarks, _warning(form, reason)))
    with tempfile.TemporaryDirectory() as place:
        for name, content in made.files.items():
            (Path(place) / name).write_bytes(content)
        file = "problem.yaml" if form == "petab" else next(name for name in made.files if name.endswith(".xml"))
        try:
            found = importing.import_file(Path(place) / file, Path(place) / "again")
            model = frontend.load_model(found.model, Findings())
            if form == "petab":
                quantity = Quantity("likelihood", _likelihood(source, found, options), LIKELIHOOD)
            else:
                quantity = Quantity("rates", _rates(source, exported, reference(model)), SLOPES)
        except (UserError, ComputationError) as problem:
            return replace(made, remarks=(*made.remarks, _unchecked(form, problem)))
    require(form, [quantity])
    return replace(made, checked=(*made.checked, quantity))


def _unchecked(form: str, problem: UserError | ComputationError) -> Diagnostic:
    return _warning(form, problem.diagnostics[0].message if isinstance(problem, UserError) else str(problem))


def _warning(form: str, reason: str) -> Diagnostic:
    message = f"the export as `{form}` was not compared, since it could not be imported again: {reason}"
    return Diagnostic("GB892", message, None, severity=Severity.WARNING)


def _rates(source: Subject, exported: Exported, again: Subject) -> float:
    """The largest difference of the rates of states at random points, relative to the largest of each state."""
    rng, model = np.random.default_rng(0), source.model
    places = [again.model.state_index[s.name] for s in model.states if s.name in again.model.state_index]
    ours = [i for i, s in enumerate(model.states) if s.name in again.model.state_index]
    found, known = [], []
    start = np.array([0.5 if s.start is None else s.start for s in model.states])
    for _ in range(POINTS):
        x = start * rng.uniform(0.5, 1.5, len(start)) + rng.uniform(0.1, 0.2, len(start))
        y = np.zeros(len(again.model.states))
        y[places] = x[ours]
        slopes = source.evaluator.rhs_many(0.0, x[None], exported.conditions, exported.inputs)
        known.append(np.asarray(slopes).ravel()[ours])
        found.append(np.asarray(again.evaluator.rhs_many(0.0, y[None])).ravel()[places])
    size = np.abs(np.array(known)).max(axis=0)
    return float(np.max(np.abs(np.array(found) - np.array(known)) / np.where(size > 0, size, 1.0), initial=0.0))


def _likelihood(source: Subject, found: importing.Import, options: ExportOptions) -> float:
    """The difference of the negative log likelihoods, relative to their size."""
    assert options.data is not None
    assert found.data is not None
    if source.run is None:
        assert source.origin is not None
        before = evaluating.of_model(source.origin, options.data, source.values)
    else:
        before = evaluating.of_run(source.run, options.data, source.values, source.member)
    model = frontend.load_model(found.model, Findings())
    after = evaluating.of_model(model, tables.read_data(found.data, model, Findings()))
    return abs(after.nllh - before.nllh) / max(abs(before.nllh), 1.0)
