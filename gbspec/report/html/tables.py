"""The tables of the page."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.frames import counted
from gbspec.ir import Model
from gbspec.json_values import JsonObject
from gbspec.report import collect
from gbspec.report.noises import learned_noises
from gbspec.report.text import distributions, ends_of, interval_of, number, share
from gbspec.runs import Run


@dataclass(frozen=True)
class Table:
    """A table: header and rows of texts."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


_SCALES = {"logarithms": "logarithms", "counts": "counts on the scale of their noise"}
"""What errors are of that are not of values, by the keys that say so."""


def _errors(channels: JsonObject) -> Table:
    """The errors of channels."""
    keys = ("n", "rmse", "nrmse", "mae", "r2")
    told = any(one.get(of) for one in channels.values() for of in _SCALES)
    header = ("channel", *keys, *(["nrmse and r2 of"] if told else []))
    rows = []
    for name, one in channels.items():
        scale = [next((text for of, text in _SCALES.items() if one.get(of)), "values")] if told else []
        rows.append((name, *(number(one[key], 5) for key in keys[:-1]), share(one[keys[-1]]), *scale))
    return Table(header, tuple(rows))


def constants(run: Run) -> Table:
    """Learned constants with intervals, starting values and truths; with the intervals of profiles if there are any."""
    rows = []
    known = collect.constants(run)
    profiled = any(one.profile is not None for one in known)
    for one in known:
        between = ends_of(one.interval)
        error = f"{100 * abs(one.value / one.truth - 1):.2g} %" if one.truth else "-"
        made = (interval_of(one.profile),) if profiled else ()
        rows.append((one.name, number(one.value, 6), one.unit or "-", between, *made, number(one.start),
                     number(one.truth, 6), error))  # fmt: skip
    for noise in learned_noises(run):
        made = ("-",) if profiled else ()
        rows.append((noise.title, number(noise.value, 6), noise.unit or "-", ends_of(noise.interval), *made, "-", "-",
                     "-"))  # fmt: skip
    ends = ("90 % interval", *(["profile"] if profiled else []))
    return _without_empty(Table(("constant", "value", "unit", *ends, "start", "truth", "off by"), tuple(rows)))


def _without_empty(table: Table) -> Table:
    """The table without columns in which no row says anything."""
    kept = [k for k in range(len(table.header)) if any(row[k] != "-" for row in table.rows)]
    return Table(tuple(table.header[k] for k in kept), tuple(tuple(row[k] for k in kept) for row in table.rows))


def few_constants(run: Run) -> Table:
    """Learned constants with their unit and interval, for the first screen; truths where there are any."""
    found = collect.constants(run)
    true = any(one.truth is not None for one in found)
    rows = []
    for one in found:
        unit = f" {one.unit}" if one.unit else ""
        between = ends_of(one.interval, 5)
        own = run.fit.constants[one.name].per_trajectory
        if own:
            values = [each.value for each in own.values()]
            effect = None if run.fit.population is None else run.fit.population.effects.get(one.name)
            unit += " (mean)" if effect is None or effect.distribution == "normal" else " (median)"
            known = f"{between}; " if one.interval is not None and effect is not None else ""
            between = f"{known}trajectories: {number(min(values), 3)} to {number(max(values), 3)}"
        truth = [number(one.truth)] if true else []
        rows.append((one.name, number(one.value, 5) + unit, between, *truth))
    for noise in learned_noises(run):
        unit = f" {noise.unit}" if noise.unit else ""
        rows.append((noise.title, number(noise.value, 5) + unit, ends_of(noise.interval, 5), *(["-"] if true else [])))
    return Table(("constant", "value", "90 % interval", *(["truth"] if true else [])), tuple(rows))


def distributed(run: Run) -> Table:
    """The distributions of constants with their shrinkage; no rows if the model has none."""
    if run.fit.population is None:
        return Table((), ())
    header, rows = distributions(run.fit.population)
    return Table(tuple(header), tuple(map(tuple, rows)))


def own_constants(run: Run) -> Table:
    """The constants of each trajectory with their intervals; no rows if the model has none."""
    rows = [
        (one.name, label, number(float(value), 6), f"{number(float(low))} to {number(float(high))}")
        for one in collect.own_constants(run)
        for label, value, low, high in zip(one.labels, one.values, one.low, one.high, strict=True)
    ]
    return Table(("constant", "trajectory", "value", "90 % interval"), tuple(rows))


def correlations(run: Run) -> Table:
    """Correlations of the learned constants; no rows if they are not known."""
    known = run.fit.correlations
    rows = [(name, *(f"{value:.3f}" for value in row.values())) for name, row in known.items()]
    return Table(("correlation", *known), tuple(rows))


def declared(model: Model) -> Table:
    """The meaning of each declared name."""
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


def metrics(validation: JsonObject) -> dict[str, Table]:
    """The numbers of `gbspec validate`: errors on the data, and against the truth."""
    found = {}
    channels = validation["channels"]
    ahead = validation.get("ahead") or {}
    for steps, errors in ahead.items():
        if steps != "all":  # that stands in the table of solutions from the start, with learned starts
            found[f"on the data, {counted(int(steps), 'row')} ahead"] = _errors(errors)
    if channels:
        found["on the data" + (", from the start alone, without disturbances" if ahead else "")] = _errors(channels)
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
