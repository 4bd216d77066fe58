"""The tables of a study: `table.md` with the paper's numbers, `results.csv` with one row per member, `study.json`."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Mapping, Sequence

from gbspec.data import Case
from gbspec.files import write_text
from gbspec.runs import files
from gbspec.studies.member import NORMS, Place
from gbspec.studies.record import (
    CaseSummary,
    CpuSeconds,
    Fitted,
    MemberStatistics,
    MetricSummary,
    Norms,
    Record,
    Summary,
    read_record,
)
from gbspec.studies.start_tables import joined_eigenvalues, joined_states, sections
from gbspec.studies.tasks import Study

METRICS = {
    "solution": "solution",
    "rhs": "right-hand side",
    "functions": "functions",
    "constants": "constants",
    "data": "data (nrmse)",
}
"""Names of metrics in the records and in the table; without a truth the metric of the data."""
SINGLE = ("constants", "data")
"""Metrics with one number instead of three norms."""


def write_tables(study: Study, place: Place, command: str) -> Summary:
    """Writes the three files from the existing records; returns the content of `study.json`."""
    records: dict[str, list[Record]] = {case.name: [] for case in study.cases}
    for task in study.tasks():
        record = read_record(place.record(task))
        if record is not None:
            records[task.case.name].append(record)
    summary = summarise(study, records, command)
    place.root.mkdir(parents=True, exist_ok=True)
    files.write_json(place.root / "study.json", summary.to_json())
    write_text(place.root / "results.csv", results(records))
    write_text(place.root / "table.md", markdown(summary))
    return summary


def summarise(study: Study, records: Mapping[str, Sequence[Record]], command: str) -> Summary:
    """The content of `study.json`: statistics over the finished members, case by case."""
    everything = [record for several in records.values() for record in several]
    return Summary(
        command,
        study.seed,
        _versions(everything),
        tuple(sorted({record.machine for record in everything})),
        max((record.finished for record in everything), default=None),
        {
            case.name: _case(case, count, training.effort, records[case.name])
            for case, count, training in zip(study.cases, study.members, study.training, strict=True)
        },
    )


def _versions(records: Sequence[Record]) -> dict[str, tuple[str, ...]]:
    """The versions of gbspec and its libraries with which the members were fitted."""
    found: dict[str, set[str]] = {}
    for one in _fitted(records):
        for name, version in one.versions.items():
            found.setdefault(name, set()).add(version)
    return {name: tuple(sorted(versions)) for name, versions in found.items()}


def _fitted(records: Sequence[Record]) -> list[Fitted]:
    return [record.fitted for record in records if record.fitted is not None]


def _case(case: Case, planned: int, effort: str, records: Sequence[Record]) -> CaseSummary:
    metrics = {}
    for metric in METRICS:
        values = {norm: [_value(record, metric, norm) for record in records] for norm in NORMS}
        if not any(math.isfinite(value) for value in values["L2"]):
            values = {}
        if values or metric in case.published:
            norms = {norm: member_statistics(v) for norm, v in values.items() if any(map(math.isfinite, v))}
            metrics[metric] = MetricSummary(case.published.get(metric), **norms)
    fitted = _fitted(records)
    cpu = [one.cpu_seconds for one in _fitted([record for record in records if not record.resumed])]
    return CaseSummary(
        title=case.title,
        model=case.model.stem if case.model else None,
        members=len(records),
        planned=planned,
        fit_of=next((record.fit_of for record in records if record.fit_of is not None), None),
        effort=effort,
        noise=case.sampling.noise,
        failed=tuple(record.member for record in records if record.failure is not None),
        step_warnings=tuple(r.member for r in records if r.fitted is not None and r.fitted.step_warning),
        cpu_seconds=CpuSeconds(statistics.median(cpu), max(cpu), len(cpu)) if cpu else None,
        metrics=metrics,
        eigenvalues=joined_eigenvalues([one.eigenvalues for one in fitted if one.eigenvalues is not None]),
        initial_states=joined_states([one.initial_states for one in fitted if one.initial_states is not None]),
    )


def member_statistics(values: Sequence[float]) -> MemberStatistics:
    """The statistics of at least one number."""
    finite = all(math.isfinite(value) for value in values)
    ordered = sorted(values)
    middle = len(ordered) // 2
    median = ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2
    mean = statistics.fmean(values) if finite else math.inf
    sd = statistics.stdev(values) if finite and len(values) > 1 else math.nan
    return MemberStatistics(mean, sd, median, ordered[-1])


def _value(record: Record, metric: str, norm: str) -> float:
    """A metric of a member; infinite if the fit failed, or some of the points could not be computed."""
    entry = _norms(record, metric)
    value = entry.get(norm)
    return math.inf if value is None or entry.get("failed") else float(value)


def _norms(record: Record, metric: str) -> Norms:
    return record.fitted.errors.get(metric, {}) if record.fitted is not None else {}


# ------------------------------------------------------------------------------------------------------- results.csv
def results(records: Mapping[str, Sequence[Record]]) -> str:
    """One row per member; cells without a number are empty."""
    columns = [f"{metric}_{norm}" for metric, norm in _COLUMNS]
    names = sorted({name for several in records.values() for one in _fitted(several) for name in one.constants})
    head = ["case", "member", "seed", "failure", "cpu_seconds", "wall_seconds", "resumed", "step_warning", "loss"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*head, *columns, *(f"constant_{name}" for name in names)])
    for case, several in records.items():
        for record in several:
            found, row = record.fitted, [case, record.member, record.seed, record.failure]
            if found is None:
                row += [None, None, record.resumed, False, None]
            else:
                row += [found.cpu_seconds, found.wall_seconds, record.resumed, bool(found.step_warning), found.loss]
            row += [_norms(record, metric).get(norm) for metric, norm in _COLUMNS]
            row += [found.constants.get(name) if found is not None else None for name in names]
            writer.writerow(["" if cell is None else cell for cell in row])
    return text.getvalue()


_COLUMNS = [(metric, norm) for metric in METRICS for norm in NORMS if metric not in SINGLE or norm == "L2"]
"""The columns of a row of results."""


# ---------------------------------------------------------------------------------------------------------- table.md
def markdown(summary: Summary) -> str:
    """The table in Markdown: errors and published errors, then the costs and warnings of the fits."""
    versions = ", ".join(f"{name} {'/'.join(several)}" for name, several in summary.versions.items())
    lines = [
        "# Study",
        "",
        f"`{summary.command}`",
        "",
        f"Each member has its own seed for data and initial weights, counted from {summary.seed}. Errors are the L2 "
        "norms of the paper's appendix, for constants the mean relative error; L1 and Linf are in `results.csv`. "
        "A factor is the published error divided by this one: above 1 is better than published.",
        "",
        "| case | error | published | mean ± sd | median | worst | factor (median) | factor (worst) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, case in summary.cases.items():
        for metric, entry in case.metrics.items():
            lines.append(_row(name, metric, entry))
    lines += [
        "",
        "| case | description | members | failed | step warnings | CPU s per member: median (maximum) |",
        "|---|---|---|---|---|---|",
    ]
    for name, case in summary.cases.items():
        cpu = case.cpu_seconds
        time = f"{cpu.median:.0f} ({cpu.most:.0f})" if cpu else ""
        what = case.title + (f"; effort {case.effort}" if case.effort != "normal" else "")
        what += f"; noise {case.noise:g}" if case.noise else ""
        what += f"; the fits of {case.fit_of}" if case.fit_of else ""
        counts = f"{case.members} of {case.planned} | {len(case.failed)} | {len(case.step_warnings)}"
        lines.append(f"| {name} | {what} | {counts} | {time} |")
    lines += sections(summary.cases)
    lines += ["", f"Fitted with {versions or 'nothing yet'}; {', '.join(summary.machines)}; last {summary.last}."]
    return "\n".join(lines) + "\n"


def _row(case: str, metric: str, entry: MetricSummary) -> str:
    published, ours = entry.published, entry.L2
    cells = [case, METRICS[metric], number(published)]
    if ours is None:
        return "| " + " | ".join([*cells, "", "", "", "", ""]) + " |"
    sd = f" ± {number(ours.sd)}" if math.isfinite(ours.sd) else ""
    mean = number(ours.mean) + sd if math.isfinite(ours.mean) else "failed"
    cells += [mean, number(ours.median), number(ours.worst)]
    for value in (ours.median, ours.worst):
        cells.append(f"{published / value:.3g}" if published and math.isfinite(value) and value else "")
    return "| " + " | ".join(cells) + " |"


def number(value: float | None) -> str:
    """A number with three digits; `failed` if it is not finite because a member failed."""
    if value is None:
        return ""
    return f"{value:.2e}" if math.isfinite(value) else "failed"
