"""`--set NAME=VALUE`: overrides the values of constants, learnables and the defaults of conditions and inputs."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from typing import TypeVar

from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.given import is_real, plain_values, require_values
from gbspec.ir import Condition, Constant, Input, Learnable, Model, Range, TruthConstant, not_categories
from gbspec.passes.contracts import with_contracts

D = TypeVar("D", Condition, Input)


def with_values(model: Model, values: Mapping[str, float]) -> Model:
    """The model with new constants, starting values and truths of learnables, and defaults of conditions and inputs.

    A learnable's bounds are widened if the value lies outside them. The text is unchanged.

    Raises:
        UserError: GB804, one diagnostic for each name that is none of these, or whose value is not finite; GB383 for
            numbers of no category; GB6xx if a contract cannot be guaranteed with these values.
        TypeError: if these are no values by name.
    """
    require_values(values)
    names = [*model.constant_names, *(c.name for c in model.conditions), *(i.name for i in model.inputs)]
    problems = [problem for name, value in values.items() if (problem := _problem(name, value, names)) is not None]
    if not problems:
        problems += not_categories(model.conditions, {name: (value,) for name, value in values.items()})
    if problems:
        raise UserError(problems)
    values = plain_values(values)
    learnable = {k.name for k in model.learnables}
    truths = {t.name: t.value for t in model.truth_constants}
    truths.update({name: value for name, value in values.items() if name in learnable and name in truths})
    changed = dataclasses.replace(
        model,
        constants=tuple(_constant(c, values) for c in model.constants),
        learnables=tuple(_learnable(k, values) for k in model.learnables),
        conditions=tuple(_default(c, values) for c in model.conditions),
        inputs=tuple(_default(i, values) for i in model.inputs),
        truth_constants=tuple(TruthConstant(name, value) for name, value in truths.items()),
    )
    # Proofs about contracts may depend on the values that were replaced.
    findings = Findings()
    changed = with_contracts(changed, findings)
    findings.raise_if_failed()
    return changed


def _problem(name: str, value: float, names: list[str]) -> Diagnostic | None:
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        known = ", ".join(f"`{n}`" for n in names[:12]) or "none"
        help_ = f"did you mean `{close[0]}`?" if close else f"names that can be set are: {known}"
        return Diagnostic(
            "GB804", f"`{name}` cannot be set: it is not a constant, condition or input of the model", None, help=help_
        )
    if not (is_real(value) and math.isfinite(value)):
        return Diagnostic("GB804", f"the value {value!r} for `{name}` is not a finite number", None)
    return None


def _constant(constant: Constant, values: Mapping[str, float]) -> Constant:
    return dataclasses.replace(constant, value=values.get(constant.name, constant.value))


def _learnable(learnable: Learnable, values: Mapping[str, float]) -> Learnable:
    if learnable.name not in values:
        return learnable
    value = values[learnable.name]
    bounds = Range(min(learnable.range.low, value), max(learnable.range.high, value))
    return dataclasses.replace(learnable, start=value, range=bounds)


def _default(item: D, values: Mapping[str, float]) -> D:
    return dataclasses.replace(item, default=values.get(item.name, item.default))
