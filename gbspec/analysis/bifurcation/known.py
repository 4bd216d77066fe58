"""Whether a steady state or a cycle is on a curve that was followed: anywhere on it, not only next to its points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.analysis.bifurcation.collocation import DEGREE, Collocation, Orbit, along, inner, phase
from gbspec.analysis.bifurcation.curve import Curve, CurvePoint
from gbspec.analysis.bifurcation.limit_cycle import Place, extremes
from gbspec.arrays import Array

SAME = 1e-6
"""Points of a curve that differ by less, in scaled variables, are one."""
BESIDE = 0.1
"""How far a point may be from the interpolated curve, relative to the step, to be compared with it by Newton's method;
the tangent turns so little in a step that the curve itself is much closer."""
BEYOND = 0.02
"""How far a point may be beyond a step, relative to its length."""
REACH = 0.1
"""How far from a cycle of a curve, in scaled variables, another is compared with it by Newton's method: two steps."""
SAME_CYCLE = 1e-3
"""Cycles that differ by less, in scaled variables, are one: on different meshes they differ by the error of these."""
SAMPLES = 512


def on_curve(curve: Curve, y: Array, points: Sequence[CurvePoint]) -> bool:
    """Whether y [m+1] is one of `points`, which follow each other on the curve, or a point of it between neighbours.

    The hyperplane through y across a step meets the curve once, also at a fold, where a value of the parameter meets it
    twice or not at all. Newton's method in that plane starts from the cubic through both ends with their tangents, so
    that it leads to this branch rather than to another that runs close by.
    """
    nodes = np.array([point.y for point in points])
    if np.min(np.max(np.abs(nodes - y), axis=1)) < SAME:  # also just beyond the end of a curve
        return True
    chords = np.diff(nodes, axis=0)
    lengths = np.maximum(np.linalg.norm(chords, axis=1), 1e-150)
    parts = np.sum((y - nodes[:-1]) * chords, axis=1) / lengths**2
    # A cheap bound for the guess, which is at most a fraction of the step away from the chord
    away = np.max(np.abs(nodes[:-1] + parts[:, None] * chords - y), axis=1)
    near = (parts > -BEYOND) & (parts < 1.0 + BEYOND) & (away < 2.0 * BESIDE * lengths + SAME)
    for i in map(int, np.flatnonzero(near)):
        guess = _between(points[i], points[i + 1], chords[i], float(lengths[i]), float(parts[i]))
        normal = chords[i] / lengths[i]
        guess = guess + ((y - guess) @ normal) * normal
        if np.max(np.abs(guess - y)) > BESIDE * lengths[i] + SAME:
            continue
        if np.max(np.abs(guess - y)) < SAME / 10.0:  # also at a degenerate point, where Newton's method fails
            return True
        corrected = curve.correct(guess, normal)
        if corrected is not None and np.max(np.abs(corrected[0] - y)) < SAME:
            return True
    return False


def _between(a: CurvePoint, b: CurvePoint, chord: Array, length: float, s: float) -> Array:
    """The cubic through both points at a part s of the step; their tangents may point either way."""
    first, last = (length * point.tangent * np.sign(point.tangent @ chord) for point in (a, b))
    bend = s * (1.0 - s) * ((1.0 - s) * (first - chord) - s * (last - chord))
    return np.asarray(a.y + s * chord + bend)


def on_cycles(equations: Collocation, orbit: Orbit, places: Sequence[Place]) -> bool:
    """Whether a cycle is one of the curve of cycles of these places, also between two of them.

    Cycles are compared as a whole, in phase with each other, with period and parameter: one of twice the period is
    another. The curve is met in the hyperplane through the cycle across the tangent of a place nearby.
    """
    sizes = extremes(orbit)
    near = []
    for place in places:
        other = place.orbit
        apart = max(abs(other.log_period - orbit.log_period), abs(other.parameter - orbit.parameter))
        if apart < REACH and np.max(np.abs(np.subtract(extremes(other), sizes))) < 3.0 * REACH:
            aligned = in_phase(orbit, other)
            near.append((_distance(aligned, other), place, aligned))
    for apart, place, aligned in sorted(near, key=lambda one: one[0])[:4]:
        if apart > REACH:
            break
        length = inner(place.tangent, _minus(aligned, place.orbit))
        guess = place.orbit.moved(place.tangent, length)
        corrected = equations.correct(guess, (phase(place.orbit), along(place.tangent)))
        if corrected is not None and _distance(in_phase(orbit, corrected[0]), corrected[0]) < SAME_CYCLE:
            return True
    return False


def in_phase(orbit: Orbit, reference: Orbit) -> Orbit:
    """The orbit on the mesh of another and with its phase: at the shift at which they correlate most."""
    from scipy.optimize import brentq

    s = np.arange(SAMPLES) / SAMPLES
    here, there = (np.fft.rfft(one.at(s), axis=0) for one in (orbit, reference))
    shift = float(np.argmax(np.fft.irfft(np.sum(here * there.conj(), axis=1), SAMPLES))) / SAMPLES
    nodes = (reference.mesh[:-1, None] + np.diff(reference.mesh)[:, None] * (np.arange(DEGREE) / DEGREE)).ravel()

    def shifted(by: float) -> Orbit:
        return Orbit(reference.mesh, orbit.at((nodes + by) % 1.0), orbit.log_period, orbit.parameter)

    condition = phase(reference)
    ends = shift - 1.0 / SAMPLES, shift + 1.0 / SAMPLES
    if condition(shifted(ends[0])) * condition(shifted(ends[1])) < 0.0:
        shift = float(brentq(lambda by: condition(shifted(by)), *ends, xtol=1e-12))
    return shifted(shift)


def _minus(a: Orbit, b: Orbit) -> Orbit:
    """The difference of two orbits on one mesh."""
    return Orbit(a.mesh, a.nodes - b.nodes, a.log_period - b.log_period, a.parameter - b.parameter)


def _distance(a: Orbit, b: Orbit) -> float:
    difference = _minus(a, b)
    return float(np.sqrt(inner(difference, difference)))
