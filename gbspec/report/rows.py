"""What a model declares and what a run learned, as rows of data frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gbspec.ir import Declared, Model, Range
    from gbspec.runs import Run


def declared_rows(model: Model) -> Iterator[dict[str, object]]:
    """One row for each declared name."""
    yield _row("time", model.time, None, None)
    for state in model.states:
        yield _row("state", state, None, state.range)
    for condition in model.conditions:
        yield _row("condition", condition, condition.default, condition.range)
    for item in model.inputs:
        yield _row("input", item, item.default, item.range)
    for constant in model.constants:
        yield _row("constant", constant, constant.value, None)
    for learnable in model.learnables:
        yield _row("learned", learnable, learnable.start, learnable.range)
    for unknown in model.unknowns:
        yield _row("unknown", unknown, None, None)
    for channel in model.channels:
        yield _row("channel", channel, None, None)


def _row(role: str, item: Declared, value: float | None, span: Range | None) -> dict[str, object]:
    low, high = (None, None) if span is None else (float(span.low), float(span.high))
    return {
        "name": item.name,
        "role": role,
        "value": value,
        "low": low,
        "high": high,
        "unit": item.unit,
        "description": item.description or None,
    }


def constant_rows(run: Run) -> Iterator[dict[str, object]]:
    """One row for each learned constant, and one for each trajectory of those per trajectory."""
    units = {learnable.name: learnable.unit for learnable in run.model.learnables}
    for name, entry in run.fit.constants.items():
        low, high = entry.interval or (None, None)
        row: dict[str, object] = {
            "constant": name,
            "trajectory": None,
            "value": entry.value,
            "sd": entry.sd,
            "low": low,
            "high": high,
            "start": entry.start,
            "unit": units.get(name),
        }
        yield row
        for label, own in (entry.per_trajectory or {}).items():
            low, high = own.interval or (None, None)
            yield {**row, "trajectory": label, "value": own.value, "sd": None, "low": low, "high": high}
