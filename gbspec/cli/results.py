"""What a fit says, as text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gbspec.cli.output import number, table

if TYPE_CHECKING:
    from gbspec.runs.store import Run


def fitted(run: Run) -> str:
    """A run in a few lines: constants with their spread and interval, errors of each member, warnings."""
    fit: dict[str, Any] = run.fit
    parts = [f"{run.model.name}: {run.model.title}" if run.model.title else run.model.name]
    truths = {t.name: t.value for t in run.model.truth_constants}
    rows = []
    for name, entry in fit.get("constants", {}).items():
        if not isinstance(entry.get("value"), int | float):
            continue
        interval = entry.get("interval")
        between = f"{number(interval[0])} to {number(interval[1])}" if interval and None not in interval else "-"
        cells = [name, number(entry["value"], 6), number(entry.get("sd"), 2), between, number(truths.get(name), 6)]
        rows.append(cells)
    if rows:
        header = ["constant", "value", "sd", "interval", "truth"]
        keep = header if truths else header[:-1]
        parts.append(table(keep, [row[: len(keep)] for row in rows]))
    members = fit.get("members", [])
    if members:
        channels = list(members[0].get("rmse", {}))
        lines = [[str(i), number(m.get("loss")), *_rmse(m, channels), _seconds(m)] for i, m in enumerate(members)]
        parts.append(table(["member", "loss", *(f"rmse {c}" for c in channels), "time"], lines))
    parts += [f"warning: {warning}" for warning in fit.get("warnings", [])]
    return "\n\n".join(parts)


def _rmse(member: dict[str, Any], channels: list[str]) -> list[str]:
    return [number(member.get("rmse", {}).get(channel)) for channel in channels]


def _seconds(member: dict[str, Any]) -> str:
    return f"{member.get('seconds') or 0:.0f} s"
