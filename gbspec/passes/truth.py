"""Substitutes the truth for the learnables and unknowns of a model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import sympy

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Constant, Expr, Model, TruthFunction, symbol, unknown_function


def with_truth(model: Model) -> Model:
    """A model without unknowns: each application of an unknown is replaced by the body of its truth.

    Learnables become constants with the value of their truth, else their starting value, so that a complete model needs
    no truth. The order of the constants' vector is kept: known constants first, then former learnables.

    Raises:
        UserError: GB803, one diagnostic for each unknown without a truth.
    """
    truths = {truth.name: truth for truth in model.truth_functions}
    missing = [unknown for unknown in model.unknowns if unknown.name not in truths]
    if missing:
        raise UserError(
            Diagnostic(
                "GB803",
                f"the unknown `{unknown.name}` has no truth, so the model is incomplete",
                unknown.span,
                label="to be learned",
                help=f"add `truth {unknown.name}"
                f"({', '.join(a.name for a in model.networks[unknown.network].arguments)}) = …` to the model, "
                "or give a trained run instead of the model",
                subject=unknown.name,
            )
            for unknown in missing
        )
    values = {truth.name: truth.value for truth in model.truth_constants}
    learned = tuple(
        Constant(k.name, values.get(k.name, k.start), unit=k.unit, description=k.description, span=k.span)
        for k in model.learnables
    )
    put = _substitution(truths)
    return dataclasses.replace(
        model,
        constants=(*model.constants, *learned),
        learnables=(),
        networks=(),
        unknowns=(),
        intermediates=tuple(dataclasses.replace(i, value=put(i.value)) for i in model.intermediates),
        balances=tuple(put(b) for b in model.balances),
        constraints=tuple(dataclasses.replace(e, left=put(e.left), right=put(e.right)) for e in model.constraints),
        channels=tuple(dataclasses.replace(c, value=put(c.value)) for c in model.channels),
        events=tuple(
            dataclasses.replace(
                e,
                guard=None if e.guard is None else put(e.guard),
                condition=None if e.condition is None else put(e.condition),
                values=tuple((name, put(value)) for name, value in e.values),
            )
            for e in model.events
        ),
        claims=tuple(dataclasses.replace(c, value=put(c.value), rate=put(c.rate)) for c in model.claims),
        arrays=tuple(dataclasses.replace(a, ends=tuple((i, put(v)) for i, v in a.ends)) for a in model.arrays),
        families=tuple(dataclasses.replace(f, value=put(f.value)) for f in model.families),
        truth_constants=(),
        truth_functions=(),
    )


def _substitution(truths: dict[str, TruthFunction]) -> Callable[[Expr], Expr]:
    """A function that replaces every application of an unknown by its truth's body, nested applications first."""
    bodies = {unknown_function(name): truth for name, truth in truths.items()}
    done: dict[Expr, Expr] = {}

    def put(expression: Expr) -> Expr:
        applications = [a for a in expression.atoms(sympy.core.function.AppliedUndef) if a.func in bodies]
        for application in sorted(applications, key=_nesting):
            if application not in done:
                truth = bodies[application.func]
                arguments = (argument.xreplace(done) for argument in application.args)
                formals = (symbol(name) for name in truth.parameters)
                done[application] = truth.value.xreplace(dict(zip(formals, arguments, strict=True)))
        return expression.xreplace(done) if applications else expression

    return put


def _nesting(application: Expr) -> int:
    """The number of applications in an application, itself included: inner ones sort first."""
    return len(application.atoms(sympy.core.function.AppliedUndef))
