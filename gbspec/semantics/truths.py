"""Checks `truth` statements: their targets, their arguments, and the values of truths of learnables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from gbspec.diagnostics import Findings, Label
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.numbers import functions_of
from gbspec.semantics.sites import Sites
from gbspec.semantics.table import Declaration, Table
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import Kind, ast


def check(items: Iterable[Item], table: Table, findings: Findings, merged: Merged) -> list[ast.TruthStatement]:
    """The truths with a declared target and the right number of arguments; the others are reported."""
    good: list[ast.TruthStatement] = []
    for item in items:
        if isinstance(item.statement, ast.TruthStatement):
            truth = item.statement
            declaration = table.get(truth.target.text)
            if declaration is None:
                if merged.lacks(truth.target.text):
                    _missing(truth, table, findings)
            elif declaration.kind not in (Kind.LEARN, Kind.UNKNOWN):
                _known(truth, declaration, findings)
            elif _same_arguments(truth, declaration, findings):
                good.append(truth)
    return good


def _missing(truth: ast.TruthStatement, table: Table, findings: Findings) -> None:
    pool = [n for n, d in table.items() if d.kind in (Kind.LEARN, Kind.UNKNOWN)]
    findings.error(
        "GB219",
        f"a truth for `{truth.target.text}`, which is not declared",
        truth.target.span,
        label="not declared",
        help=suggestion(truth.target.text, pool) or "a truth is for a `learn` or an `unknown` of this model",
        subject=truth.target.text,
    )


def _known(truth: ast.TruthStatement, declaration: Declaration, findings: Findings) -> None:
    name = truth.target.text
    findings.error(
        "GB219",
        f"a truth for `{name}`, which is {declaration.kind.value}",
        truth.target.span,
        labels=[Label(declaration.span, "declared here")] if declaration.span is not None else [],
        help="only a `learn` or an `unknown` can have a truth; delete it"
        + (f", or declare `learn {name}`" if declaration.kind is Kind.CONST else "")
        + (f" (in a file that extends another: `without truth {name}`)" if declaration.kind is Kind.CONST else ""),
    )


def _same_arguments(truth: ast.TruthStatement, declaration: Declaration, findings: Findings) -> bool:
    unknown = declaration.statement if isinstance(declaration.statement, ast.UnknownStatement) else None
    expected = len(unknown.arguments) if unknown is not None else 0
    if truth.parameters is None or (unknown is not None and len(truth.parameters) == expected):
        return True
    labels = [Label(declaration.span, "declared here")] if declaration.span is not None else []
    if unknown is None:
        message, help_ = (
            f"`{truth.target.text}` is a learnable constant and has no arguments",
            "leave the arguments out",
        )
    else:
        names = ", ".join(a.name.text for a in unknown.arguments)
        count = f"{len(truth.parameters)} argument{'' if len(truth.parameters) == 1 else 's'}"
        message = f"the truth of `{truth.target.text}` has {count}, its declaration {expected}"
        help_ = f"write `truth {truth.target.text}({names}) = …`"
    findings.error("GB220", message, truth.target.span, labels=labels, help=help_)
    return False


def values(
    truths: Iterable[ast.TruthStatement],
    sites: Sites,
    table: Table,
    constants: Mapping[str, float],
    starts: Mapping[str, float],
    findings: Findings,
) -> dict[str, float]:
    """Values of the truths of learnables; other learnables in them have their truths, else starting values."""
    waiting = {t.target.text: t for t in truths if table[t.target.text].kind is Kind.LEARN and sites.complete(t.value)}
    known: dict[str, float] = {}
    while waiting:
        ready = [n for n, t in waiting.items() if not any(o in waiting for o in _learnables(t, sites, table))]
        if not ready:
            _circle(waiting, findings)
            break
        for name in ready:
            truth = waiting.pop(name)
            value = Evaluator({**constants, **starts, **known}, functions_of(table))(truth.value)
            if value is not None:
                known[name] = value
            elif not findings.failed:
                findings.error("GB223", f"the truth of `{name}` is not a finite number", truth.value.span)
    return known


def _learnables(truth: ast.TruthStatement, sites: Sites, table: Table) -> list[str]:
    names = sites[truth.value].references.names
    return [n for n in names if table[n].kind is Kind.LEARN]


def _circle(waiting: Mapping[str, ast.TruthStatement], findings: Findings) -> None:
    names = ", ".join(f"`{n}`" for n in waiting)
    first = next(iter(waiting.values()))
    findings.error(
        "GB208",
        f"truths depend on each other in a cycle: {names}",
        first.target.span,
        labels=[Label(t.target.span, "and this") for t in list(waiting.values())[1:5]],
        help="write the number of one of them",
    )
