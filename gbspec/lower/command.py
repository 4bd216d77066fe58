"""Expressions from the command line in the names of a Model."""

from __future__ import annotations

from collections.abc import Sequence

import sympy

from gbspec.diagnostics import Findings
from gbspec.ir import Expr, symbol, unknown_function
from gbspec.ir import model as ir
from gbspec.lower.expressions import build
from gbspec.semantics import suggestion
from gbspec.syntax import FUNCTIONS, ast


def lower_expression(expression: ast.Expression, model: ir.Model, findings: Findings) -> Expr:
    """An expression or condition from the command line, such as `x2 > 4`, in a Model's names.

    Names are the time, states, conditions, inputs, constants, and intermediates; unknowns may be applied. Any
    other name is recorded as an error; the result must then not be used.
    """
    names = {model.time.name, *model.constant_names}
    for group in (model.states, model.conditions, model.inputs, model.intermediates):
        names.update(item.name for item in group)
    arity = {u.name: len(model.networks[u.network].arguments) for u in model.unknowns}

    def missing(name: ast.Name, pool: set[str]) -> Expr:
        findings.error(
            "GB201",
            f"there is no `{name.text}` in the model `{model.name}`",
            name.span,
            label="not declared",
            help=suggestion(name.text, pool) or "known names: " + ", ".join(f"`{n}`" for n in sorted(pool)[:12]),
            subject=name.text,
        )
        return sympy.S.Zero

    def naming(name: ast.Name) -> Expr:
        return symbol(name.text) if name.text in names else missing(name, names)

    def calling(call: ast.Call, arguments: Sequence[Expr]) -> Expr:
        if arity.get(call.function.text) == len(arguments):
            return unknown_function(call.function.text)(*arguments)
        if call.function.text in arity:
            return _wrong_count(call, arity[call.function.text], findings)
        return missing(call.function, set(arity) | set(FUNCTIONS))

    return build(expression, naming, calling)


def _wrong_count(call: ast.Call, expected: int, findings: Findings) -> Expr:
    findings.error(
        "GB207", f"`{call.function.text}` takes {expected} arguments, {len(call.arguments)} are given", call.span
    )
    return sympy.S.Zero
