"""Checks the columns of the data: no two quantities may be read from the same one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import assert_never

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics.merge import Item
from gbspec.semantics.table import Table
from gbspec.syntax import Kind, ast, target_name


def check(items: Iterable[Item], table: Table, findings: Findings) -> None:
    """Reports channels, inputs, conditions, doses, the time and `trajectory` that share a column."""
    first: dict[str, tuple[str, Span | None]] = {"trajectory": ("the number of the trajectory", None)}
    first.update({d.name: ("the time", d.span) for d in table.values() if d.kind is Kind.TIME})
    for column, what, span in _columns(items):
        earlier = first.setdefault(column, (what, span))
        if earlier[1] is span or earlier[0] == what:  # a name declared or observed twice is reported elsewhere
            continue
        findings.error(
            "GB231",
            f"{what} would be read from the column `{column}`, which is that of {earlier[0]}",
            span,
            labels=[Label(earlier[1], "this one")] if earlier[1] is not None else [],
            help='give it another column, `as "another name"`, or another name',
        )


def _columns(items: Iterable[Item]) -> Iterator[tuple[str, str, Span]]:
    for item in items:
        match item.statement:
            case (
                ast.ConditionStatement(name=name, column=column)
                | ast.InputStatement(name=name, column=column)
                | ast.ObserveStatement(target=name, column=column)
            ):
                yield _column(target_name(name), column)
            case ast.DoseStatement(target=target, duration=duration):
                name = target_name(target)
                yield f"dose_{name.text}", f"the dose into `{name.text}`", name.span
                if duration is not None:
                    yield f"infusion_{name.text}", f"the rate of infusion into `{name.text}`", name.span
            case ast.Remark() | ast.Formula() | ast.TimeStatement() | ast.StateStatement() | ast.AlgebraicStatement():
                pass
            case ast.LearnStatement() | ast.UnknownStatement():
                pass
            case _:
                assert_never(item.statement)


def _column(name: ast.Name, column: ast.Text | None) -> tuple[str, str, Span]:
    what = f"`{name.text}`"
    return (column.value, what, column.span) if column is not None else (name.text, what, name.span)
