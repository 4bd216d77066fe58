"""Declarations of functions to be learned: arguments, outputs, postulates, networks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics import contracts
from gbspec.semantics.expressions import walk
from gbspec.semantics.merge import Item
from gbspec.semantics.numbers import Numbers
from gbspec.semantics.vocabulary import ACTIVATIONS, suggestion
from gbspec.syntax import ast, ungrouped

WIDEST = 4096
"""The maximal number of units of a hidden layer."""

MOST_COEFFICIENTS = 60
"""The maximal number of coefficients of a spline in one argument."""

DEFAULT_WIDTHS = (32, 32)
DEFAULT_ACTIVATION = "silu"


def check(items: Iterable[Item], numbers: Numbers, findings: Findings) -> None:
    """Checks unknowns and parameter lists, each statement separately."""
    for statement in (item.statement for item in items):
        if isinstance(statement, ast.FunctionStatement):
            _parameters(statement.parameters, statement.name, findings)
        elif isinstance(statement, ast.TableStatement):
            _parameters([a.name for a in statement.arguments], statement.name, findings)
        elif isinstance(statement, ast.TruthStatement) and statement.parameters is not None:
            _parameters(statement.parameters, statement.target, findings, empty=True)
        elif isinstance(statement, ast.UnknownStatement):
            _parameters([a.name for a in statement.arguments], statement.names[0], findings)
            _counts(statement, findings)
            _postulates(statement, findings)
            contracts.check(statement, findings)
            if statement.network is not None:
                _network(statement.network, len(statement.arguments), numbers, findings)


def _parameters(names: Sequence[ast.Name], owner: ast.Name, findings: Findings, *, empty: bool = False) -> None:
    if not names and not empty:
        findings.error(
            "GB215",
            f"`{owner.text}` has no argument",
            owner.span,
            help="a number to be learned is `learn k = 1`; an expression with a name is `let k = …`",
        )
    first: dict[str, ast.Name] = {}
    for name in names:
        earlier = first.setdefault(name.text, name)
        if earlier is not name:
            findings.error(
                "GB214",
                f"the argument `{name.text}` occurs twice",
                name.span,
                labels=[Label(earlier.span, "the first")],
                help="give each argument its own name",
            )


def _counts(unknown: ast.UnknownStatement, findings: Findings) -> None:
    outputs = len(unknown.names)
    given: list[tuple[str, Sequence[ast.Node]]] = [("units", unknown.units), ("postulates", unknown.postulates)]
    for what, parts in given:
        if len(parts) not in (0, 1, outputs):
            findings.error(
                "GB229",
                f"{len(parts)} {what} for {outputs} output{'s' if outputs > 1 else ''}",
                parts[0].span.to(parts[-1].span),
                labels=[Label(unknown.names[0].span.to(unknown.names[-1].span), "the outputs")],
                help="give one for all outputs, or one for each, in their order",
            )


def _postulates(unknown: ast.UnknownStatement, findings: Findings) -> None:
    for postulate in unknown.postulates:
        if not any(isinstance(node, ast.Name) and node.text == "nn" for node in walk(postulate)):
            findings.error(
                "GB230",
                "the postulate has no `nn`, so there is nothing to learn",
                postulate.span,
                help=f"say where the network corrects it: `({postulate.span.text})*nn` or `{postulate.span.text} + nn`;"
                f" if the form is known, declare a `function`",
            )


def _network(network: ast.NetworkSpec, arguments: int, numbers: Numbers, findings: Findings) -> None:
    if network.kind.text == "spline":
        _spline(network, arguments, numbers, findings)
        return
    if network.kind.text != "mlp":
        findings.error(
            "GB228",
            f"there is no network named `{network.kind.text}`",
            network.kind.span,
            help="write `by mlp(32, 32)`, a multilayer perceptron with two hidden layers of 32, or `by spline(12)`",
        )
        return
    for width in network.widths:
        value = numbers.value(width)
        if value is not None and not (value == int(value) and 1 <= value <= WIDEST):
            findings.error(
                "GB228",
                f"a hidden layer cannot have {value:g} units",
                width.span,
                help=f"a width is a whole number from 1 to {WIDEST}",
            )
    seen: set[str] = set()
    for option in network.options:
        _option(option, seen, findings)


def _spline(network: ast.NetworkSpec, arguments: int, numbers: Numbers, findings: Findings) -> None:
    """Reports wrong numbers of arguments and coefficients, and options."""

    def wrong(message: str, place: Span, help: str) -> None:
        findings.error("GB228", message, place, help=help)

    if arguments > 2:
        wrong("a spline has one or two arguments", network.span, "write `by mlp(32, 32)`")
    if len(network.widths) not in (1, arguments):
        text = "one number of coefficients" + (", or one for each argument" if arguments > 1 else "")
        wrong(f"`spline` takes {text}", network.span, "write `by spline(12)`")
    for width in network.widths:
        value = numbers.value(width)
        if value is not None and not (value == int(value) and 4 <= value <= MOST_COEFFICIENTS):
            limits = f"a whole number from 4 to {MOST_COEFFICIENTS}"
            wrong(f"a cubic spline cannot have {value:g} coefficients", width.span, f"their number is {limits}")
    for option in network.options:
        wrong(f"`spline` has no option `{option.name.text}`", option.name.span, "delete it")


def _option(option: ast.Option, seen: set[str], findings: Findings) -> None:
    name, value = option.name.text, ungrouped(option.value)
    if name != "activation":
        findings.error(
            "GB228",
            f"`mlp` has no option `{name}`",
            option.name.span,
            help="its only option is `activation`; options of training are given on the command line",
        )
    elif name in seen:
        findings.error("GB228", "the activation is given twice", option.span, help="delete one of them")
    elif not isinstance(value, ast.Name) or value.text not in ACTIVATIONS:
        near = suggestion(value.text, ACTIVATIONS) if isinstance(value, ast.Name) else ""
        findings.error(
            "GB228",
            f"there is no activation named `{option.value.span.text}`",
            option.value.span,
            help=" ".join(part for part in (near, "activations are " + ", ".join(ACTIVATIONS)) if part),
        )
    seen.add(name)


def network_widths(network: ast.NetworkSpec | None, numbers: Numbers) -> tuple[int, ...]:
    """Widths of the hidden layers of a checked network."""
    if network is None or not network.widths:
        return DEFAULT_WIDTHS
    if network.kind.text == "spline":
        return ()
    return tuple(int(numbers.value(width) or 0) for width in network.widths)


def network_activation(network: ast.NetworkSpec | None) -> str:
    """The activation of a checked network."""
    for option in network.options if network is not None else ():
        value = ungrouped(option.value)
        if isinstance(value, ast.Name):
            return value.text
    return DEFAULT_ACTIVATION


def spline_sizes(network: ast.NetworkSpec | None, arguments: int, numbers: Numbers) -> tuple[int, ...]:
    """Numbers of coefficients of a checked spline in each argument; empty for other networks."""
    if network is None or network.kind.text != "spline":
        return ()
    found = [int(numbers.value(width) or 4) for width in network.widths]
    return tuple(found * arguments if len(found) == 1 else found)
