"""Substitutes values in a model's text, so that the model kept in a run directory is the one that was used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from gbspec.diagnostics import Findings, Source
from gbspec.syntax.ast import (
    Bound,
    ConditionStatement,
    ConstStatement,
    Expression,
    InputStatement,
    Interval,
    LearnStatement,
)
from gbspec.syntax.parser import parse

Edit = tuple[int, int, str]


def with_settings(source: Source, values: Mapping[str, float]) -> str:
    """The text with these values of constants, starting values of learnables, and defaults of conditions and inputs.

    Bounds of a learnable and ranges of conditions and inputs are widened to a value that lies outside; comments,
    order and everything else stay. Names that the text does not declare as one of these are ignored.

    Raises:
        UserError: the text has syntax errors.
    """
    findings = Findings()
    file = parse(source, findings)
    findings.raise_if_failed()
    text = source.text
    edits = [edit for s in (file.statements if file else ()) for edit in _edits(s, values)]
    for start, end, new in sorted(edits, reverse=True):  # from the end on, so that earlier offsets stay valid
        text = text[:start] + new + text[end:]
    return text


def _edits(statement: object, values: Mapping[str, float]) -> Iterator[Edit]:
    match statement:
        case ConstStatement(name=name, value=old) if name.text in values:
            yield old.span.start, old.span.end, repr(values[name.text])
        case LearnStatement(name=name, start=start, range=interval, bounds=bounds) if name.text in values:
            value = values[name.text]
            yield _given(name.span.end, start, value)
            yield from _widened(interval, value)
            yield from (edit for bound in bounds for edit in _moved(bound, value))
        case (ConditionStatement() | InputStatement()) as known if known.name.text in values:
            value = values[known.name.text]
            yield _given(known.name.span.end, known.default, value)
            yield from _widened(known.range, value)


def _given(place: int, old: Expression | None, value: float) -> Edit:
    return (place, place, f" = {value!r}") if old is None else (old.span.start, old.span.end, repr(value))


def _widened(interval: Interval | None, value: float) -> Iterator[Edit]:
    if interval is None:
        return
    low, high = _number(interval.low), _number(interval.high)
    if low is not None and value < low:
        yield interval.low.span.start, interval.low.span.end, repr(value)
    if high is not None and value > high:
        yield interval.high.span.start, interval.high.span.end, repr(value)


def _moved(bound: Bound, value: float) -> Iterator[Edit]:
    limit = _number(bound.value)
    if limit is not None and (value < limit if bound.operator.startswith(">") else value > limit):
        yield bound.value.span.start, bound.value.span.end, repr(value)


def _number(expression: Expression) -> float | None:
    """The value of a literal with its sign; None for any other expression (checked later)."""
    try:
        return float(expression.span.text.replace(" ", ""))
    except ValueError:
        return None
