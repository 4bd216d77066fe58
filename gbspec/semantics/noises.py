"""Checks `noise student(scale, df)`: its degrees of freedom are a number or one learnable constant, above zero."""

from __future__ import annotations

from collections.abc import Iterable

from gbspec.diagnostics import Findings
from gbspec.semantics.merge import Item
from gbspec.semantics.numbers import Numbers
from gbspec.syntax import ast

CODE = "GB431"


def check(items: Iterable[Item], numbers: Numbers, findings: Findings) -> None:
    """Reports noises of Student's distribution that are not written as they must be."""
    items = list(items)
    learned = {i.statement.name.text: i.statement for i in items if isinstance(i.statement, ast.LearnStatement)}
    for statement in (i.statement for i in items if isinstance(i.statement, ast.ObserveStatement)):
        noise = statement.noise
        if noise is None or noise.kind.text != "student":
            continue
        if len(noise.arguments) != 2:
            findings.error(
                CODE,
                "`noise student` takes two numbers: the scale and the degrees of freedom",
                noise.span,
                help="write `noise student(0.1, 5)`, or names of learned constants",
            )
            continue
        _scale(noise.arguments[0], numbers, findings)
        _freedom(noise.arguments[1], learned, numbers, findings)


def _scale(argument: ast.Expression, numbers: Numbers, findings: Findings) -> None:
    value = numbers.value(argument)
    if value is not None and value <= 0:
        findings.error(CODE, "the scale of `noise student` must be positive", argument.span)


def _freedom(
    argument: ast.Expression, learned: dict[str, ast.LearnStatement], numbers: Numbers, findings: Findings
) -> None:
    inner = argument
    while isinstance(inner, ast.Group):
        inner = inner.inner
    if isinstance(inner, ast.Name) and inner.text in learned:
        ends = numbers.bounds(learned[inner.text])
        if ends is not None and ends[0] <= 0:
            findings.error(
                CODE,
                f"`{inner.text}`, the degrees of freedom, may become zero",
                argument.span,
                help=f"bound it, for example `learn {inner.text} = 5 in [1, 100]`",
            )
        return
    value = numbers.value(argument)
    if value is not None and value <= 0:
        findings.error(CODE, "the degrees of freedom must be positive", argument.span)
    elif value is None and numbers.sites.complete(argument):
        findings.error(
            CODE,
            "the degrees of freedom are neither a number nor the name of a learnable constant",
            argument.span,
            help="write for example `noise student(s, df)` with `learn df = 5 in [1, 100]`",
        )
