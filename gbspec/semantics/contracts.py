"""Checks that the names in the contracts of unknowns are arguments and outputs.

Whether the contracts can hold is decided on the Model (`gbspec.passes.contracts`), where postulates are expressions.
"""

from __future__ import annotations

from gbspec.diagnostics import Findings, Label
from gbspec.semantics.expressions import walk
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import ast


def check(unknown: ast.UnknownStatement, findings: Findings) -> None:
    """Reports wrong names in an unknown's contracts (GB601, GB602, GB604)."""
    for contract in unknown.contracts:
        _output(contract, unknown, findings)
        match contract:
            case ast.Shaped(argument=argument):
                _argument(argument, unknown, findings)
            case ast.ZeroAt(argument=argument, value=value):
                if _argument(argument, unknown, findings):
                    _own_argument(argument, value, "the place of a zero in", findings)
            case ast.EqualsAt(value=value, argument=argument, place=place):
                if _argument(argument, unknown, findings):
                    _own_argument(argument, place, "the place of a value in", findings)
                    _own_argument(argument, value, "the value at a place of", findings)
            case ast.Periodic(period=period, argument=argument):
                if _argument(argument, unknown, findings):
                    _constant_period(period, unknown, findings)
            case ast.Bound() | ast.RangeContract():
                pass


def outputs_of(contract: ast.Contract, unknown: ast.UnknownStatement) -> tuple[str, ...]:
    """The outputs that a contract constrains: the one that it names, else all."""
    return tuple(n.text for n in unknown.names) if contract.name is None else (contract.name.text,)


def _output(contract: ast.Contract, unknown: ast.UnknownStatement, findings: Findings) -> None:
    names = [name.text for name in unknown.names]
    if contract.name is None or contract.name.text in names:
        return
    findings.error(
        "GB602",
        f"the contract is on `{contract.name.text}`, which is not an output of this unknown",
        contract.name.span,
        labels=[Label(unknown.names[0].span.to(unknown.names[-1].span), "its outputs")],
        help=suggestion(contract.name.text, names)
        or "name one of the outputs, or none: then the contract holds for all of them",
    )


def _argument(argument: ast.Name, unknown: ast.UnknownStatement, findings: Findings) -> bool:
    names = [a.name.text for a in unknown.arguments]
    if argument.text in names:
        return True
    listed = ", ".join(f"`{name}`" for name in names)
    labels = [Label(unknown.arguments[0].span.to(unknown.arguments[-1].span), "its arguments")] if names else []
    findings.error(
        "GB601",
        f"`{argument.text}` is not an argument of `{unknown.names[0].text}`",
        argument.span,
        labels=labels,
        help=suggestion(argument.text, names) or f"a contract can use the arguments {listed}",
    )
    return False


def _own_argument(argument: ast.Name, value: ast.Expression, what: str, findings: Findings) -> None:
    for node in walk(value):
        if isinstance(node, ast.Name) and node.text == argument.text:
            findings.error(
                "GB604",
                f"{what} `{argument.text}` cannot depend on `{argument.text}`",
                node.span,
                help="give it as an expression of constants, learnable constants and the other arguments",
            )
            return


def _constant_period(period: ast.Expression, unknown: ast.UnknownStatement, findings: Findings) -> None:
    formals = {argument.name.text for argument in unknown.arguments}
    for node in walk(period):
        if isinstance(node, ast.Name) and node.text in formals:
            findings.error(
                "GB604",
                f"a period cannot depend on the argument `{node.text}`",
                node.span,
                help="give it as a number, or as an expression of constants and learnable constants",
            )
            return
