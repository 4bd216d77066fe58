"""Tables: their piecewise polynomials, and the text of a model with all points in it."""

from __future__ import annotations

from collections.abc import Sequence

from gbspec.diagnostics import Span
from gbspec.ir import Curve, Table
from gbspec.lower.small import string, unit_text
from gbspec.semantics import Checked, written_out
from gbspec.syntax import ast


def lowered(checked: Checked) -> list[Table]:
    """The tables of a model."""
    return [_table(statement, checked) for statement in checked.all(ast.TableStatement)]


def _table(statement: ast.TableStatement, checked: Checked) -> Table:
    points = checked.tables[statement.name.text]
    curve = Curve(points.knots, points.values, statement.interpolation or "linear", statement.outside or "hold")
    return Table(
        statement.name.text,
        tuple(argument.name.text for argument in statement.arguments),
        curve,
        tuple(unit_text(argument.unit) for argument in statement.arguments),
        unit=unit_text(statement.unit),
        description=string(statement.description),
        span=statement.name.span,
    )


def text_of(checked: Checked) -> str:
    """The text of the file if it extends no other, else the merged statements; points from files stand in it.

    So a run, and whatever else keeps the text, needs none of these files, and a changed point is another model.
    """
    items = checked.source
    points = written_out(items, checked.tables)
    sources = {item.statement.span.source for item in items}
    if len(sources) == 1 and not any(s.extends for s in checked.all(ast.ModelStatement)):
        return _replaced(sources.pop().text, 0, points)
    # Not formatted: formatting parses the text twice more, which would slow down every check of a model.
    texts = []
    for item in items:
        span = item.statement.span
        own = [(p, t) for p, t in points if p.source is span.source and span.start <= p.start < span.end]
        texts.append(_replaced(item.text, span.start, own).rstrip())
    return "\n".join(texts) + "\n"


def _replaced(text: str, offset: int, parts: Sequence[tuple[Span, str]]) -> str:
    for span, new in sorted(parts, key=lambda part: -part[0].start):
        text = text[: span.start - offset] + new + text[span.end - offset :]
    return text
