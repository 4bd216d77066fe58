"""Models and fits as text: summaries and tables for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from gbspec.frames import counted
from gbspec.report.noises import learned_noises
from gbspec.runs import SMALL_FOR_NOISE, small_for_noise

if TYPE_CHECKING:
    from gbspec.ir import Condition, EquationBlock, Family, Initial, Learnable, Model, Network, Range, State
    from gbspec.runs import MemberRecord, PopulationRecord, ProfileRecord, Run


def number(value: float | None, digits: int = 4) -> str:
    """A number for a table: `digits` significant ones, a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits}g}"
    return f"{value:.{max(digits - 2, 1)}e}"


def ends_of(interval: tuple[float, float] | None, digits: int = 4) -> str:
    """An interval for a table, with as many digits as its width needs; a dash where there is none."""
    if interval is None or not all(map(math.isfinite, interval)):
        return "-"
    size, width = max(map(abs, interval)), interval[1] - interval[0]
    needed = math.ceil(math.log10(size / width)) + 3 if width > 0 else digits
    return " to ".join(number(end, min(max(digits, needed), 12)) for end in interval)


def share(r2: float | None) -> str:
    """An R² for a table, which is 1 only where it is."""
    from gbspec.analysis import share_text

    return number(r2, 5) if r2 is None or r2 < 0.99 else share_text(r2)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A plain text table: the first column left-aligned, the others right-aligned, two blanks between."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    shown = []
    for line in lines:
        first, *others = zip(line, widths, strict=True)
        cells = [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]
        shown.append("  ".join(cells).rstrip())
    return "\n".join([shown[0], "  ".join("-" * width for width in widths), *shown[1:]])


def listing(rows: Sequence[tuple[str, str]]) -> str:
    """Names with what they stand for, one a line, in two columns aligned to the left."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join(f"{name.ljust(width)}  {meaning}".rstrip() for name, meaning in rows)


def model_summary(model: Model) -> str:
    """A summary of a model: states and their initial values, learned and measured quantities."""
    from gbspec.ir import guarantee

    lines = [f"{model.name}" + (f': "{model.title}"' if model.title else "")]
    rows = [(name, begin, _range(s.range), s.unit or "-", s.description or "-") for name, begin, s in _states(model)]
    lines.append(_left(("state", "starts", "range", "unit", "description"), rows))
    lines += [_block(model, block) for block in model.blocks]
    for network in model.networks:
        arguments = ", ".join(argument.name for argument in network.arguments)
        lines.append(f"unknown {', '.join(network.outputs)}({arguments}): {_size(network)}")
        kept = ((unknown.name, guarantee(unknown)) for unknown in model.unknowns if unknown.name in network.outputs)
        lines += [f"  {name} {text}" for name, text in kept if text]
    lines += [f"learned {_learnable(learnable)}" for learnable in model.learnables]
    for word, names in (
        ("conditions", [_condition(c) for c in model.conditions if not c.labels]),
        ("grouped by", [c.name for c in model.conditions if c.labels]),
        ("inputs", [f"{i.name} ({i.interpolation})" for i in model.inputs]),
        ("measured", _measured(model)),
    ):
        if names:
            lines.append(f"{word} {', '.join(names)}")
    return "\n".join(lines) + "\n"


def _condition(condition: Condition) -> str:
    return f"{condition.name} ({', '.join(condition.categories)})" if condition.categories else condition.name


def _size(network: Network) -> str:
    """What stands for unknown functions, and the number of its parameters."""
    if network.spline:
        return f"cubic spline, {' x '.join(map(str, network.spline))} coefficients"
    layers = "-".join(str(n) for n in network.sizes)
    return f"network {layers} {network.activation}, {network.parameters} parameters"


def _states(model: Model) -> Iterator[tuple[str, str, State]]:
    """Name and initial value of each state; one entry for an array whose elements all have the same kind of initial
    value."""
    from gbspec.ir import Initial

    families = {family.begin: family for family in model.families if family.vector == "starts"}
    arrays = {array.position: array for array in model.arrays}
    measured = {channel.state for channel in model.channels}
    place = 0
    while place < len(model.states):
        state, array, family = model.states[place], arrays.get(place), families.get(place)
        alike = array is not None and all(s.initial == state.initial for s in model.states[place : place + array.count])
        if array is not None and (alike or family is not None):
            value = state.initial if family is None else Initial("expression", family.value)
            yield array.range, start(model, value, place in measured), state
            place += array.count
        else:
            yield state.name, start(model, state.initial, place in measured), state
            place += 1


def _block(model: Model, block: EquationBlock) -> str:
    """Which equations determine which algebraic variables, and from where these are sought."""
    sought = {item.name: item for item in model.algebraics}
    variables = [
        name + (f" in {_range(sought[name].range)}" if name in sought and sought[name].range is not None else "")
        for name in block.variables
    ]
    found = f"algebraic {', '.join(variables)} by {', '.join(block.equations)}"
    if block.explicit:
        return f"{found}, a formula"
    return found + (f", {len(variables)} equations together" if len(variables) > 1 else "")


def _measured(model: Model) -> list[str]:
    """Names of the channels; for an array that is measured as a whole, its range."""
    arrays = {array.name: array.range for array in model.arrays}
    runs = model.runs("channels")
    return [
        arrays[run.array] if not isinstance(run, int) and run.array else model.channels[_first(run)].name
        for run in runs
    ]


def _first(run: Family | int) -> int:
    return run if isinstance(run, int) else run.begin


def start(model: Model, initial: Initial, measured: bool) -> str:
    """The origin of the initial value of a state, which a channel measures as it is or not, in words."""
    from gbspec.ir import in_language

    value = "" if initial.value is None else in_language(initial.value, model.conditions)
    match initial.kind:
        case "expression":
            return f"= {value}"
        case "steady":
            return f"steady, reached from {value}"
        case "learned":
            return "learned"
        case "measured":
            return "measured, else learned" if measured else "learned"


def _learnable(learnable: Learnable) -> str:
    limited = math.isfinite(learnable.range.low) or math.isfinite(learnable.range.high)
    where = f" in {_range(learnable.range)}" if limited else ""
    return f"{learnable.name} from {number(learnable.start)}{where}{_differing(learnable)}"


def _differing(learnable: Learnable) -> str:
    """How the values of a constant differ, in the words of the language."""
    made = learnable.distribution
    if made is None:
        return " per trajectory" if learnable.per_trajectory else ""
    kind = "normal(0, 1)" if made.kind == "standard" else made.kind
    columns = ["trajectory", *(level.column for level in made.levels)]
    differ = [
        f" per {column} ~ {kind}" + (f"({spread or f'{fixed:g}'})" if made.kind != "standard" else "")
        for column, (spread, fixed) in zip(columns, made.spreads, strict=True)
        if spread or fixed or len(columns) == 1
    ]
    return "".join(differ)


def _range(given: Range | None) -> str:
    return "-" if given is None else f"[{given.low:g}, {given.high:g}]"


def _left(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with all columns left-aligned; empty columns are omitted."""
    kept = [i for i in range(len(header)) if i == 0 or any(row[i] != "-" for row in rows)]
    lines = [[line[i] for i in kept] for line in (header, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(kept))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)


SHOWN = 40
"""Trajectories whose constants are in a summary; all are in `fit.json`, the report and `plot RUN per-trajectory`."""


def _own_constants(run: Run) -> list[str]:
    """A table of the constants per trajectory, one line for each trajectory, and what is left out."""
    own = {name: entry.per_trajectory for name, entry in run.fit.constants.items() if entry.per_trajectory}
    labels = list(dict.fromkeys(label for values in own.values() for label in values))
    if not labels:
        return []
    lines = []
    for label in labels[:SHOWN]:
        cells = [label]
        for values in own.values():
            one = values.get(label)
            cells.append(number(one.value if one is not None else None, 5))
            cells.append(ends_of(one.interval if one is not None else None, 3))
        lines.append(cells)
    header = ["trajectory", *(word for name in own for word in (name, "interval"))]
    more = len(labels) - SHOWN
    left_out = [f"and {counted(more, 'more trajectory')}, in fit.json and `gbspec plot {run.path} per-trajectory`"]
    return [table(header, lines)] + (left_out if more > 0 else [])


def population_lines(run: Run) -> list[str]:
    """The likelihood of a population and its distributions; nothing for other runs."""
    found = run.fit.population
    if found is None:
        return []
    header, rows = distributions(found)
    pairs = [
        f"correlation of {a} and {b}: {value:.3f}"
        for i, (a, row) in enumerate(found.correlations.items())
        for b, value in row.items()
        if b not in list(found.correlations)[: i + 1]
    ]
    noises = [f"noise of {name}: {number(value)}" for name, value in run.fit.noise.items()]
    errors = [
        f"prediction errors of {name}: mean {one.mean:.3f}, variance {one.variance:.3f}, "
        f"p = {one.p:.2g} of being standard normal"
        for name, one in found.npde.items()
    ]
    lines = [table(header, rows)] if rows else []
    return [*lines, "\n".join([marginal_line(found), *pairs, *noises, *errors])]


def distributions(found: PopulationRecord) -> tuple[list[str], list[list[str]]]:
    """The header and the rows of a table of distributed constants; no rows without any."""
    rows = []
    for name, one in found.effects.items():
        between = f"{number(one.sd_interval[0])} to {number(one.sd_interval[1])}" if one.sd_interval else "-"
        shrinkage = "-" if one.shrinkage is None else f"{round(100 * one.shrinkage)} %"
        rows.append([name, one.distribution, number(one.median, 6), number(one.sd, 4), between, shrinkage])
    return ["distributed", "as", "median", "sd", "interval of sd", "shrinkage"], rows


def marginal_line(found: PopulationRecord) -> str:
    """The marginal likelihood, how it was computed (without distributions nothing is approximated), and what is
    compared with others."""
    way = "Laplace's method" if found.nodes == 1 else f"quadrature with {found.nodes} nodes"
    value = "not a finite number" if found.minus2ll is None else f"{found.minus2ll:.4f}"
    ended = "" if found.maximum else f"not at its maximum: {found.reason}"
    remarks = ", ".join(one for one in (way if found.effects else "", ended) if one)
    remarks = f" ({remarks})" if remarks else ""
    said = f"-2 log likelihood {value}{remarks}, {found.parameters:.4g} parameters"
    if found.aic is not None and found.bic is not None:
        said += f", AIC {found.aic:.2f}, BIC {found.bic:.2f}"
    if found.exact_hessian is not None and found.effects:
        said += f"; with the exact Hessian {found.exact_hessian:.4f}"
    return said


def likelihood_lines(run: Run) -> list[str]:
    """The likelihood of a run that was fitted by one."""
    found = run.fit.population
    return innovations_line(run) if found is None else [marginal_line(found)]


def innovations_line(run: Run) -> list[str]:
    """The likelihood of the best member's innovations, at its maximum, or where that is not known at the estimates;
    nothing for other runs."""
    found = run.innovations
    value = None if found is None else found.minus2ll if found.least is None else found.least
    if found is None or value is None:
        return []
    where = "at the estimates" if found.least is None else "at its maximum"
    where = "not at its maximum" if found.maximum is False else where
    said = f"-2 log likelihood {value:.4f} (innovations; {where}), {found.parameters} parameters"
    if found.aic is None or found.bic is None:
        return [said]
    return [f"{said}, AIC {found.aic:.2f}, BIC {found.bic:.2f}"]


def interval_of(profile: ProfileRecord | None) -> str:
    """The interval of a profile; a dash where none was made or some fit has not converged."""
    if profile is None or (all(end is None for end in profile.interval) and profile.trust in ("fit", "neither")):
        return "-"
    low, high = ("open" if end is None else number(end) for end in profile.interval)
    return f"{low} to {high}"


def profile_verdicts(run: Run) -> list[str]:
    """What profiles of constants say of the intervals of the fit, where they disagree."""
    made = ((name, run.profiled(name)) for name in run.fit.constants)
    return [f"`{name}`: {one.verdict}" for name, one in made if one is not None and one.verdict]


def run_summary(run: Run) -> str:
    """A run in a few lines: constants with their standard deviation and interval, errors of each member, warnings."""
    parts = [f"{run.model.name}: {run.model.title}" if run.model.title else run.model.name]
    truths = {t.name: t.value for t in run.model.truth_constants}
    rows = []
    for name, entry in run.fit.constants.items():
        profile, truth = interval_of(run.profiled(name)), number(truths.get(name), 6)
        rows.append([name, number(entry.value, 6), number(entry.sd, 2), ends_of(entry.interval), profile, truth])
    for one in learned_noises(run):
        rows.append([one.title, number(one.value, 6), number(one.sd, 2), ends_of(one.interval), "-", "-"])
    if rows:
        header = ["constant", "value", "sd", "interval", "profile", "truth"]
        keep = [i for i in range(len(header)) if i < 4 or any(row[i] != "-" for row in rows)]
        parts.append(table([header[i] for i in keep], [[row[i] for i in keep] for row in rows]))
    parts += [*population_lines(run), *innovations_line(run)]
    parts += _own_constants(run)
    members = run.fit.members
    if members:
        lines = [[str(i), number(m.loss), f"{m.seconds:.0f} s"] for i, m in enumerate(members)]
        parts.append(table(["member", "loss", "time"], lines))
        parts.append(_channels(members))
        parts += [*_of_scales(run), *_of_averages(members), *_of_stated_noise(members)]
    if run.fit.solver_reason:
        parts.append(f"solver `{run.fit.solver}`: {run.fit.solver_reason}")
    parts += [
        f"{stage.name}{f' of member {i}' if len(members) > 1 else ''}: {stage.remark}"
        for i, m in enumerate(members)
        for stage in m.stages
        if stage.remark
    ]
    parts += [f"warning: {warning}" for warning in (*run.fit.warnings, *profile_verdicts(run))]
    return "\n\n".join(parts)


def _of_scales(run: Run) -> list[str]:
    """What is to be said of channels whose noise is that of logarithms, and of those that are counts."""
    from gbspec.ir import counted_channels, logarithmic, said_of_scales

    channels, kinds = run.model.channels, (logarithmic(run.model), counted_channels(run.model))
    return said_of_scales("R²", *([c.name for c, one in zip(channels, marked, strict=True) if one] for marked in kinds))


def _of_averages(members: Sequence[MemberRecord]) -> list[str]:
    """What is to be said of channels with replicates and with limits."""
    channels = {name: one for member in members for name, one in (member.channels or {}).items()}
    averaged = [f"`{name}` ({one.averages} of {one.values} values)" for name, one in channels.items() if one.averages]
    limited = [f"`{name}`" for name, one in channels.items() if one.censored]
    out = [f"rmse and R² of {', '.join(averaged)}: of averages of replicates"] if averaged else []
    return out + ([f"rmse and R² of {', '.join(limited)}: of values that are not censored"] if limited else [])


def _of_stated_noise(members: Sequence[MemberRecord]) -> list[str]:
    """What is to be said of channels whose R² is small for their stated noise."""
    names = {name: [(one.channels or {}).get(name) for one in members] for name in members[0].channels or {}}
    found = [f"`{name}`" for name, each in names.items() if small_for_noise(each)]
    return [f"R² of {', '.join(found)}: {SMALL_FOR_NOISE}"] if found else []


def _channels(members: Sequence[MemberRecord]) -> str:
    """How whole solutions follow each channel, member by member, beside the best naive predictor."""
    rows = []
    for i, member in enumerate(members):
        for name, rmse in member.rmse.items():
            found = (member.channels or {}).get(name)
            known = (found.r2, found.naive, found.held) if found is not None else (None, None, None)
            count, weight = (found.values, found.weight) if found is not None else (None, None)
            limits = f" ({found.censored} censored)" if found is not None and found.censored else ""
            shown = ["-" if count is None else f"{count}{limits}", number(weight, 3)]
            predictor = found.predictor if found is not None else ""
            rows.append([str(i), name, number(rmse, 5), *map(share, known), predictor or "-", *shown])
    # The filter of a model with disturbances begins each prediction at the row before.
    filtered = any(member.likelihood is not None for member in members)
    header = [
        "member",
        "one row ahead" if filtered else "whole solutions",
        "rmse",
        "R²",
        "naive R²",
        "held-out R²",
        "naive predictor",
        "values",
        "weight",
    ]
    kept = [i for i in range(len(header)) if not rows or any(row[i] != "-" for row in rows)]
    return table([header[i] for i in kept], [[row[i] for i in kept] for row in rows])
