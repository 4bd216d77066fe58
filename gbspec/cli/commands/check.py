"""`gbspec check MODEL...`: everything that can be known before anything runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from gbspec.cli.frame import WRONG_INPUT, ExitWith, command
from gbspec.cli.output import Output
from gbspec.diagnostics import Findings, Severity, UserError
from gbspec.ir.model import Model
from gbspec.passes.conservation import Law, linear_laws
from gbspec.report.text import model_summary, start


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
        laws: Sequence[Law] = ()
        try:
            model = driver.load_model(name, findings)
        except UserError as error:
            findings.extend(error.diagnostics)
        everything.extend(findings)
        if model is not None:
            laws = linear_laws(model)
            output.summary(model_summary(model) + "".join(f"conserved {law}\n" for law in laws))
        documents.append(describe(name, model, findings, laws))
    output.findings(everything)
    output.document({"files": documents})
    warnings = [d for d in everything if d.severity is Severity.WARNING]
    if everything.failed or (strict and warnings):
        counts = f"{_count(len(everything.errors), 'error')}, {_count(len(warnings), 'warning')}"
        output.say(counts + (" (--strict counts warnings as errors)" if not everything.failed else ""))
        raise ExitWith(WRONG_INPUT)


def describe(path: str, model: Model | None, findings: Findings, laws: Sequence[Law] = ()) -> dict[str, Any]:
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
        "laws": [str(law) for law in laws],
        "identifiability": None,
        "diagnostics": [to_json(d) for d in findings],
        "channels": [channel.name for channel in parts.channels],
        "starts": {state.name: start(state.initial) for state in parts.states},
    }


def _count(n: int, word: str) -> str:
    return f"{n} {word}" + ("" if n == 1 else "s")
