"""Compares a compiled C library with the generated module."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from gbspec.data import DoseEvents, Signal
from gbspec.diagnostics import ComputationError
from gbspec.exports.c.calling import Compiled
from gbspec.exports.c.library import Library
from gbspec.exports.checking import Course, Points, Quantity, Reference, compare, draw, own
from gbspec.exports.compiling import shared_library

POINTS = 12
ACCEPTED, ACCEPTED_SLOPES, ACCEPTED_STEPS = 1e-11, 1e-11, 1e-10
ACCEPTED_EVENTS = 1e-7
SHORT = 0.02
"""The largest step with events, in the time in which a state changes by as much as it is."""
SPAN, STEPS = 0.05, 7
FLAGS = ("-std=c99", "-O1", "-fPIC", "-shared")


def verify(library: Library) -> list[Quantity]:
    """The errors of all functions of the library. Raises CompilerError if there is no compiler."""
    with tempfile.TemporaryDirectory(prefix="gbspec-export-", ignore_cleanup_errors=True) as folder:
        name = library.prefix
        sources = {f"{name}.h": library.header(), f"{name}.c": library.source()}
        path = shared_library(Path(folder), sources, Path(folder) / f"{name}.so", [f"{name}.c"], FLAGS)
        return errors(Compiled(path, library), library)


def errors(compiled: Compiled, library: Library, count: int = POINTS, seed: int = 0) -> list[Quantity]:
    """The errors of a library's functions at random points, and along a short trajectory."""
    exported, points = library.exported, draw(library.exported, count, seed)
    known = Reference(exported, library.programs, points)
    found = [
        compare("the right-hand side", compiled.values("rhs", points, known.rhs[0].shape[1]), known.rhs, ACCEPTED),
        compare("the channels", compiled.values("observe", points, known.observe[0].shape[1]), known.observe, ACCEPTED),
        compare(
            "the learned functions",
            compiled.values("functions", points, known.functions[0].shape[1]),
            known.functions,
            ACCEPTED,
        ),
    ]
    if library.model.algebraics:
        solved = compiled.values("algebraic", points, known.algebraics[0].shape[1])
        found.append(compare("the algebraic variables", solved, known.algebraics, ACCEPTED))
    if library.model.delays:
        lags, late = compiled.delays(points)
        found += [
            compare("the delays", lags, known.lags, ACCEPTED),
            compare("what is delayed", late, known.delayed, ACCEPTED),
        ]
    for name, word, pair in (
        ("rhs", "derivatives of the right-hand side", known.rhs_along),
        ("observe", "derivatives of the channels", known.observe_along),
    ):
        found.append(compare(word, compiled.along(name, points, pair[0].shape[1]), pair, ACCEPTED_SLOPES))
    return found + (
        _with_events(compiled) if library.model.events else _steps(compiled, points, known, course(library))
    )


def _steps(
    compiled: Compiled, points: Points, known: Reference, path: Course, accepted: float = ACCEPTED_STEPS
) -> list[Quantity]:
    """The errors of states and channels along a course from the first point."""
    states, late = known.trajectory(path)
    got, channels = compiled.simulate(points, path)
    sizes = np.abs(states).max(axis=0, keepdims=True) + np.abs(states)
    expected = known.channels(path, states, late)
    large = np.abs(expected).max(axis=0, keepdims=True) if len(expected) else expected
    return [
        compare("steps", got, (states, sizes), accepted),
        compare("channels along steps", channels, (expected, np.abs(expected) + large), accepted),
    ]


def _with_events(compiled: Compiled) -> list[Quantity]:
    """The same with events, from the model's own state: the module's steps are adaptive there, so that those of the
    library are taken so short that their errors do not count. Nothing where the module finds no solution."""
    library = compiled.library
    points = own(library.exported)
    known = Reference(library.exported, library.programs, points)
    short = float(known.sizes_of_steps((library.exported.step or 0.01) / SHORT)[0]) * SHORT
    try:
        return _steps(compiled, points, known, course(library, short), ACCEPTED_EVENTS)
    except ComputationError:
        return []


def course(library: Library, step: float | None = None) -> Course:
    """A short course with changes of every input and doses of every kind, at places where no step begins by chance."""
    exported, model = library.exported, library.model
    step = step or exported.step or 0.01
    span = STEPS * step
    start = exported.start
    times = start + span * np.array([0.0, 0.31, 0.5, 1.0])
    moments = start + span * np.array([0.0, 0.43, 0.8])
    inputs = tuple(Signal(moments, value * np.array([1.0, 1.05, 0.9])) for value in exported.inputs)
    doses = tuple(
        DoseEvents(start + span * np.array([0.0, 0.5, 0.61]), np.array([1.0, 0.5, 0.25])) for _ in model.doses
    )
    return Course(start, times, inputs, doses, step)
