"""What the report shows, from a run and its data: each section as charts and tables, or the reason why it is empty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy

from gbspec.analysis.prediction.predict import input_values
from gbspec.arrays import Array
from gbspec.diagnostics import UserError
from gbspec.ir.model import NN, Model, Unknown
from gbspec.report import collect, unknowns
from gbspec.report.content import ChannelFit, LearnedFunction, Slice
from gbspec.report.html import charts
from gbspec.report.text import number
from gbspec.runs.store import Run

MOST_TRAJECTORIES = 24
"""Trajectories that are drawn; of more than these, evenly chosen ones."""
MOST_POINTS = 3000
"""Points in a parity plot."""


@dataclass(frozen=True)
class Panel:
    """Charts under a heading of their own, shown when a reader chooses it: one trajectory, say."""

    label: str
    note: str
    charts: tuple[charts.Chart, ...]


def chosen(count: int) -> list[int]:
    """The trajectories that are drawn."""
    return collect.spaced(count, MOST_TRAJECTORIES)


def fits(fitted: collect.Fitted, indices: Sequence[int]) -> tuple[Panel, ...]:
    """Of each trajectory every channel, then every state that was not measured."""
    model = fitted.model
    hidden = [i for i in range(len(model.states)) if all(c.state != i for c in model.channels)]
    panels = []
    for index in indices:
        item = fitted.data.items[index]
        grid = collect.dense_times(item)
        states, channels = fitted.solutions(index, grid)
        true = fitted.true_solution(index, grid)
        shown = []
        for j, channel in enumerate(model.channels):
            rows = np.isfinite(item.values[:, j])
            reference = None if true is None else true[1][:, j]
            curve = ChannelFit(channel.name, item.times[rows], item.values[rows, j], grid, channels[:, :, j], reference)
            curve = replace(curve, unit=channel.unit or "")
            shown.append(charts.fit(curve, model.time.name, measured=bool(rows.any())))
        for i in hidden:
            reference = None if true is None else true[0][:, i]
            nothing = np.zeros(0)
            curve = ChannelFit(model.states[i].name, nothing, nothing, grid, states[:, :, i], reference)
            shown.append(charts.fit(curve, model.time.name, measured=False))
        origin = fitted.start(0, index).origin
        note = ", ".join(part for part in (collect.condition_text(model, item), f"initial state: {origin}") if part)
        panels.append(Panel(item.label, note, tuple(shown)))
    return tuple(panels)


# ------------------------------------------------------------------------------------------------------ functions
def functions(fitted: collect.Fitted) -> tuple[Panel, ...]:
    """Of each unknown its slices, planes and parity."""
    panels = []
    for function in unknowns.learned_functions(fitted):
        unknown = next(u for u in fitted.model.unknowns if u.name == function.name)
        shown = [
            charts.slice_of(function.name, piece, _trained(fitted, unknown, piece.argument),
                            _postulated(fitted, unknown, function, piece))
            for piece in function.slices
        ]  # fmt: skip
        if function.plane is not None:
            shown += charts.planes(function.name, function.plane)
        compared = charts.functions_parity(function)
        shown += [compared] if compared is not None else []
        panels.append(Panel(function.name, f"of {', '.join(function.arguments)}", tuple(shown)))
    return tuple(panels)


def _trained(fitted: collect.Fitted, unknown: Unknown, argument: str) -> charts.Trained:
    """The range of an argument in which the network was trained."""
    network = fitted.model.networks[unknown.network]
    weights: Any = fitted.evaluators[0].instance.weights
    ends = [weights.get(f"network.{network.name}.input_{end}") for end in ("low", "high")]
    if ends[0] is None or ends[1] is None:
        return None
    place = [a.name for a in network.arguments].index(argument)
    return float(ends[0][place]), float(ends[1][place])


def _postulated(fitted: collect.Fitted, unknown: Unknown, function: LearnedFunction, piece: Slice) -> Array | None:
    """The postulate along a slice, its correction doing nothing; None where the user gave none."""
    if unknown.postulate in (NN, sympy.S.Zero):
        return None
    model = fitted.model
    values = dict(zip(model.constant_names, map(float, fitted.evaluators[0].constants), strict=True))
    values |= dict(zip(function.arguments, np.median(function.points, axis=0), strict=True))
    bare = unknown.postulate.xreplace({NN: sympy.Float(unknown.neutral)})
    names = sorted(symbol.name for symbol in bare.free_symbols)
    if any(name not in values for name in names):
        return None
    columns = [piece.x if name == piece.argument else values[name] for name in names]
    computed = sympy.lambdify([sympy.Symbol(name, real=True) for name in names], bare, modules="numpy")(*columns)
    return np.asarray(np.broadcast_to(computed, piece.x.shape), dtype=np.float64)


# ------------------------------------------------------------------------------------------------- initial states
def starts(fitted: collect.Fitted, indices: Sequence[int]) -> tuple[charts.Chart, ...]:
    """Learned initial states beside bred and true ones in each mode; empty where nothing was learned of them."""
    try:
        return tuple(charts.initial_states(collect.initial_states(fitted, indices)))
    except UserError:
        return ()


# --------------------------------------------------------------------------------------------------------- parity
def parity(fitted: collect.Fitted) -> tuple[charts.Chart, ...]:
    """Each balance's right-hand side, learned against true, at the fitted states of the measured rows."""
    if fitted.truth is None:
        return ()
    true, learned = [], []
    for index, item in enumerate(fitted.data.items):
        states, _ = fitted.solutions(index, item.times)
        rows = np.isfinite(states).all(axis=(0, 2))
        at = (
            item.times[rows],
            states.mean(axis=0)[rows],
            item.condition,
            input_values(fitted.model, item, item.times)[rows],
        )
        learned.append(np.mean([e.rhs_many(*at, fitted.start(m, index).constants)
                                for m, e in enumerate(fitted.evaluators)], axis=0))  # fmt: skip
        true.append(fitted.truth.rhs_many(*at))
    both = np.concatenate(true), np.concatenate(learned)
    every = max(1, len(both[0]) // MOST_POINTS)
    return tuple(
        charts.parity(f"d{state.name}/d{fitted.model.time.name}", both[0][::every, i], both[1][::every, i])
        for i, state in enumerate(fitted.model.states)
    )


# --------------------------------------------------------------------------------------------------------- tables
@dataclass(frozen=True)
class Table:
    """A table: header and rows of texts."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def constants_table(run: Run) -> Table:
    """Learned constants with intervals, starts and truths."""
    rows = []
    for one in collect.constants(run):
        between = "-" if one.interval is None else f"{number(one.interval[0])} to {number(one.interval[1])}"
        error = f"{100 * abs(one.value / one.truth - 1):.2g} %" if one.truth else "-"
        rows.append((one.name, number(one.value, 6), between, number(one.start), number(one.truth, 6), error))
    return Table(("constant", "value", "90 % interval", "start", "truth", "off by"), tuple(rows))


def correlations_table(run: Run) -> Table:
    """Correlations of the learned constants; no rows where they are not known."""
    known = run.fit.get("correlations", {})
    rows = [(name, *(f"{value:.3f}" for value in row.values())) for name, row in known.items()]
    return Table(("correlation", *known), tuple(rows))


def declared_table(model: Model) -> Table:
    """What each name means."""
    groups = (("state", model.states), ("condition", model.conditions), ("input", model.inputs),
              ("constant", model.constants), ("learned", model.learnables), ("unknown", model.unknowns),
              ("measured", model.channels))  # fmt: skip
    rows = [(item.name, kind, item.unit or "-", item.description or "-") for kind, group in groups for item in group]
    kept = any(row[2] != "-" for row in rows), any(row[3] != "-" for row in rows)
    header = ("name", "is a", *(["unit"] if kept[0] else []), *(["meaning"] if kept[1] else []))
    return Table(
        header,
        tuple((*row[:2], *([row[2]] if kept[0] else []), *([row[3]] if kept[1] else [])) for row in rows),
    )


def metrics_tables(validation: dict[str, Any]) -> dict[str, Table]:
    """The numbers of `gbspec validate`: errors on the data, and against the truth."""
    found = {}
    channels = validation["channels"]
    if channels:
        keys = ("n", "rmse", "nrmse", "mae", "r2")
        rows = tuple((name, *(number(one[key], 5) for key in keys)) for name, one in channels.items())
        found["on the data"] = Table(("channel", *keys), rows)
    truth = validation.get("truth")
    if truth:
        norms = {"solution": truth["solution"], "right-hand side": truth["rhs"], **truth["functions"]}
        kinds = ("L1", "L2", "Linf")
        compared = tuple((name, *(number(one[kind]) for kind in kinds)) for name, one in norms.items() if one)
        found["against the truth"] = Table(("of", *kinds), compared)
    check = validation.get("step_check") or {}
    again = (("at half the step", check.get("half_step")), ("by an adaptive solver", check.get("adaptive")))
    solved = tuple((name, number(value)) for name, value in again)
    found["the solver's step"] = Table(("solved again", "largest normalised difference"), solved)
    return found
