"""`gbspec check MODEL...`: everything that can be known before anything runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import sympy
import typer

from gbspec.cli.frame import WRONG_INPUT, ExitWith, command
from gbspec.cli.output import Output, number
from gbspec.diagnostics import Findings, Severity, UserError
from gbspec.ir.model import Initial, Learnable, Model, Range


@command("check", "gbspec check my_model.gb", "gbspec check --strict --json models/*.gb")
def run(
    output: Output,
    models: Annotated[list[str], typer.Argument(help="Model files, or shipped models by name.", metavar="MODEL...")],
    strict: Annotated[bool, typer.Option("--strict", help="Count warnings as errors.")] = False,
) -> None:
    """Check models: names, balances, cycles, and how each state starts; all findings at once."""
    from gbspec import driver

    everything, documents = Findings(), []
    for name in models:
        findings = Findings()
        model: Model | None = None
        try:
            model = driver.load_model(name, findings)
        except UserError as error:
            findings.extend(error.diagnostics)
        everything.extend(findings)
        documents.append(describe(name, model, findings))
        if model is not None:
            output.summary(summary(model))
    output.findings(everything)
    output.document({"files": documents})
    warnings = [d for d in everything if d.severity is Severity.WARNING]
    if everything.failed or (strict and warnings):
        counts = f"{_count(len(everything.errors), 'error')}, {_count(len(warnings), 'warning')}"
        output.say(counts + (" (--strict counts warnings as errors)" if not everything.failed else ""))
        raise ExitWith(WRONG_INPUT)


def describe(path: str, model: Model | None, findings: Findings) -> dict[str, Any]:
    """One entry of `files` of `check --json`; of a model that cannot be read the parts are empty."""
    from gbspec.diagnostics.render import to_json

    parts = model or Model("")
    return {
        "path": path,
        "model": model.name if model else None,
        "states": [state.name for state in parts.states],
        "conditions": [condition.name for condition in parts.conditions],
        "inputs": [item.name for item in parts.inputs],
        "constants": [constant.name for constant in parts.constants],
        "learnables": [learnable.name for learnable in parts.learnables],
        "unknowns": [
            {"names": n.outputs, "arguments": [a.name for a in n.arguments], "parameters": n.parameters}
            for n in parts.networks
        ],
        "laws": [],
        "identifiability": None,
        "diagnostics": [to_json(d) for d in findings],
        "channels": [channel.name for channel in parts.channels],
        "starts": {state.name: start(state.initial) for state in parts.states},
    }


def summary(model: Model) -> str:
    """What a person wants to see confirmed: states and their starts, what is learned, what is measured."""
    lines = [f"{model.name}" + (f': "{model.title}"' if model.title else "")]
    rows = [(s.name, start(s.initial), _range(s.range), s.unit or "-", s.description or "-") for s in model.states]
    lines.append(_left(("state", "starts", "range", "unit", "description"), rows))
    for network in model.networks:
        arguments = ", ".join(argument.name for argument in network.arguments)
        layers = "-".join(str(n) for n in (len(network.arguments), *network.hidden, len(network.outputs)))
        outputs = ", ".join(network.outputs)
        size = f"network {layers} {network.activation}, {network.parameters} parameters"
        lines.append(f"unknown {outputs}({arguments}): {size}")
    lines += [f"learned {_learnable(learnable)}" for learnable in model.learnables]
    for word, names in (
        ("conditions", [c.name for c in model.conditions]),
        ("inputs", [f"{i.name} ({i.interpolation})" for i in model.inputs]),
        ("measured", [c.name for c in model.channels]),
    ):
        if names:
            lines.append(f"{word} {', '.join(names)}")
    return "\n".join(lines) + "\n"


def start(initial: Initial) -> str:
    """How a state starts, in words."""
    match initial.kind:
        case "expression":
            return f"= {sympy.sstr(initial.value, full_prec=False)}"
        case "learned":
            return "learned"
        case "measured":
            return "measured, else learned"


def _learnable(learnable: Learnable) -> str:
    where = f" in {_range(learnable.range)}" if learnable.range != Range() else ""
    scope = " per trajectory" if learnable.per_trajectory else ""
    return f"{learnable.name} from {number(learnable.start)}{where}{scope}"


def _range(given: Range | None) -> str:
    return "-" if given is None else f"[{given.low:g}, {given.high:g}]"


def _left(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table with every column to the left; columns that say nothing are left out."""
    kept = [i for i in range(len(header)) if i == 0 or any(row[i] != "-" for row in rows)]
    lines = [[line[i] for i in kept] for line in (header, *rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(kept))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def _count(n: int, word: str) -> str:
    return f"{n} {word}" + ("" if n == 1 else "s")
