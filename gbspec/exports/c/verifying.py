"""Compares a compiled C library with the generated module."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from gbspec.data import DoseEvents, Signal
from gbspec.exports.c.calling import Compiled
from gbspec.exports.c.library import Library
from gbspec.exports.checking import Course, Quantity, Reference, compare, draw
from gbspec.exports.compiling import shared_library

POINTS = 12
ACCEPTED, ACCEPTED_SLOPES, ACCEPTED_STEPS = 1e-11, 1e-11, 1e-10
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
    for name, word, pair in (
        ("rhs", "derivatives of the right-hand side", known.rhs_along),
        ("observe", "derivatives of the channels", known.observe_along),
    ):
        found.append(compare(word, compiled.along(name, points, pair[0].shape[1]), pair, ACCEPTED_SLOPES))
    if library.model.events:  # the library has no steps with events: the unit takes them
        return found
    path = course(library)
    states = known.trajectory(path)
    got, channels = compiled.simulate(points, path)
    sizes = np.abs(states).max(axis=0, keepdims=True) + np.abs(states)
    found.append(compare("steps", got, (states, sizes), ACCEPTED_STEPS))
    expected = known.channels(path, states)
    large = np.abs(expected).max(axis=0, keepdims=True) if len(expected) else expected
    found.append(compare("channels along steps", channels, (expected, np.abs(expected) + large), ACCEPTED_STEPS))
    return found


def course(library: Library) -> Course:
    """A short course with changes of every input and doses of every kind, at places where no step begins by chance."""
    exported, model = library.exported, library.model
    step = exported.step or 0.01
    span = STEPS * step
    start = exported.start
    times = start + span * np.array([0.0, 0.31, 0.5, 1.0])
    moments = start + span * np.array([0.0, 0.43, 0.8])
    inputs = tuple(Signal(moments, value * np.array([1.0, 1.05, 0.9])) for value in exported.inputs)
    doses = tuple(
        DoseEvents(start + span * np.array([0.0, 0.5, 0.61]), np.array([1.0, 0.5, 0.25])) for _ in model.doses
    )
    return Course(start, times, inputs, doses, step)
