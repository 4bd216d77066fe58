"""Checks the noises with a density of their own: how many parameters they take, and that these are above zero.

The shape (the degrees of freedom of `student`, the size of `negative_binomial`) is a number or one learnable constant.
"""

from __future__ import annotations

from collections.abc import Iterable

from gbspec.diagnostics import Findings
from gbspec.ir import WITH_DENSITY, NoiseForm
from gbspec.semantics.merge import Item
from gbspec.semantics.numbers import Numbers
from gbspec.syntax import ast

CODE = "GB431"

_MEANINGS = {"scale": "the scale", "df": "the degrees of freedom", "k": "the size"}
_WORDS = {1: "one number", 2: "two numbers"}


def check(items: Iterable[Item], numbers: Numbers, findings: Findings) -> None:
    """Reports noises with a density of their own that are not written as they must be."""
    items = list(items)
    learned = {i.statement.name.text: i.statement for i in items if isinstance(i.statement, ast.LearnStatement)}
    for statement in (i.statement for i in items if isinstance(i.statement, ast.ObserveStatement)):
        noise = statement.noise
        form = WITH_DENSITY.get(noise.kind.text) if noise is not None else None
        if noise is None or form is None:
            continue
        if len(noise.arguments) != len(form.parameters):
            _number(noise, form, findings)
            continue
        if form.parameters and not form.counts:
            _scale(noise.arguments[0], form, numbers, findings)
        if form.shape:
            _shape(noise.arguments[-1], form, learned, numbers, findings)


def _number(noise: ast.Distribution, form: NoiseForm, findings: Findings) -> None:
    """Reports a wrong number of parameters."""
    if not form.parameters:
        message = f"`noise {form.kind}` takes no number: the prediction is the mean and the variance of the counts"
        findings.error(
            CODE,
            message,
            noise.span,
            help=f"write `noise {form.kind}`, or of counts that vary more `noise negative_binomial(k)` with "
            "`learn k = 10 in [0.1, 1e4]`",
        )
        return
    listed = " and ".join(_MEANINGS[name] for name in form.parameters)
    findings.error(
        CODE,
        f"`noise {form.kind}` takes {_WORDS[len(form.parameters)]}: {listed}",
        noise.span,
        help=f"write `noise {form.example}`, or names of learned constants",
    )


def _scale(argument: ast.Expression, form: NoiseForm, numbers: Numbers, findings: Findings) -> None:
    value = numbers.value(argument)
    if value is not None and value <= 0:
        findings.error(CODE, f"the scale of `noise {form.kind}` must be positive", argument.span)


def _shape(
    argument: ast.Expression,
    form: NoiseForm,
    learned: dict[str, ast.LearnStatement],
    numbers: Numbers,
    findings: Findings,
) -> None:
    inner, plural = argument, form.shape.endswith("freedom")
    while isinstance(inner, ast.Group):
        inner = inner.inner
    if isinstance(inner, ast.Name) and inner.text in learned:
        ends = numbers.bounds(learned[inner.text])
        if ends is not None and ends[0] <= 0:
            findings.error(
                CODE,
                f"`{inner.text}`, the {form.shape}, may become zero",
                argument.span,
                help=f"bound it, for example `learn {inner.text} = {form.bounds}`",
            )
        return
    value = numbers.value(argument)
    if value is not None and value <= 0:
        findings.error(CODE, f"the {form.shape} must be positive", argument.span)
    elif value is None and numbers.sites.complete(argument):
        name = form.parameters[-1]
        written = ", ".join([*("s" for _ in form.parameters[:-1]), name])
        findings.error(
            CODE,
            f"the {form.shape} {'are' if plural else 'is'} neither a number nor the name of a learnable constant",
            argument.span,
            help=f"write for example `noise {form.kind}({written})` with `learn {name} = {form.bounds}`",
        )
