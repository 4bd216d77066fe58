"""`gbspec check MODEL...`: all checks of a model that need no data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gbspec.cli.frame import WRONG_INPUT, ExitWith, command
from gbspec.cli.output import Output
from gbspec.cli.standard_input import read
from gbspec.diagnostics import Findings, Severity, UserError
from gbspec.frames import counted

if TYPE_CHECKING:
    from gbspec.ir import Model
    from gbspec.passes import Examination


@command(
    "check", "gbspec check my_model.gb", "gbspec check --strict --json models/*.gb", "gbspec check - < my_model.gb"
)
def run(
    output: Output,
    models: Annotated[
        list[str],
        typer.Argument(help="Models: files, bundled names, - for standard input.", metavar="MODEL"),
    ],
    strict: Annotated[bool, typer.Option("--strict", help="Count warnings as errors.")] = False,
) -> None:
    """Check models: names, units, balances, identifiability, and initial values; report all findings at once."""
    from gbspec import frontend
    from gbspec.passes import examine
    from gbspec.report import model_summary

    everything, documents = Findings(), []
    for name in models:
        findings = Findings()
        model: Model | None = None
        examination: Examination | None = None
        try:
            model = frontend.load_model(name, findings, read)
        except UserError as error:
            findings.extend(error.diagnostics)
        if model is not None:
            examination = examine(model, findings)
            output.summary(model_summary(model) + examination_summary(examination))
        everything.extend(findings)
        documents.append(describe(name, model, findings, examination))
    output.findings(everything)
    output.document({"files": documents})
    warnings = [d for d in everything if d.severity is Severity.WARNING]
    if everything.failed or (strict and warnings):
        counts = f"{counted(len(everything.errors), 'error')}, {counted(len(warnings), 'warning')}"
        output.say(counts + (" (--strict counts warnings as errors)" if not everything.failed else ""))
        raise ExitWith(WRONG_INPUT)


def describe(
    path: str, model: Model | None, findings: Findings, examination: Examination | None = None
) -> dict[str, object]:
    """One entry of `files` of `check --json`; its lists are empty if the model cannot be read."""
    from gbspec.diagnostics import to_json
    from gbspec.ir import Model, guarantee
    from gbspec.report import start

    parts = model or Model("")
    measured = {channel.state for channel in parts.channels}
    return {
        "path": path,
        "model": model.name if model else None,
        "states": [state.name for state in parts.states],
        "conditions": [condition.name for condition in parts.conditions if not condition.labels],
        "inputs": [item.name for item in parts.inputs],
        "constants": [constant.name for constant in parts.constants],
        "learnables": [learnable.name for learnable in parts.learnables],
        "unknowns": [
            {
                "names": n.outputs,
                "arguments": [a.name for a in n.arguments],
                "parameters": n.parameters,
                "contracts": {u.name: guarantee(u) for u in parts.unknowns if u.name in n.outputs and u.contracts},
            }
            for n in parts.networks
        ],
        "laws": [str(law) for law in examination.laws] if examination else [],
        "identifiability": identifiability(examination) if examination else None,
        "diagnostics": [to_json(d) for d in findings],
        "channels": [channel.name for channel in parts.channels],
        "starts": {s.name: start(parts, s.initial, i in measured) for i, s in enumerate(parts.states)},
        "groups": groups(parts),
    }


def groups(model: Model) -> list[dict[str, object]]:
    """The columns of the table by which constants differ (`per COLUMN`), each with these constants."""
    from gbspec.passes import differing

    names = {group.condition.name: [k.name for k in group.members] for group in differing(model)}
    for learned in model.distributed:
        for level in learned.distribution.levels if learned.distribution is not None else ():
            names.setdefault(level.column, []).append(learned.name)
    columns = {condition.name: condition.column or condition.name for condition in model.conditions}
    return [{"column": columns.get(name, name), "constants": constants} for name, constants in names.items()]


def identifiability(examination: Examination) -> dict[str, object]:
    """Structurally non-identifiable groups of constants and functions, for JSON."""
    answer = examination.identifiability
    sets = [
        {
            "constants": found.constants,
            "unknowns": found.unknowns,
            "transformation": found.transformation or None,
            "with_states_measured": found.measured_states,
            "states": found.states,
        }
        for found in answer.sets
    ]
    return {
        "decided": answer.decided,
        "inseparable": sets,
        "reasons": [each.lstrip(": ") for each in reasons(examination)],
    }


def examination_summary(examination: Examination) -> str:
    """Conservation laws, and whether identifiability could be decided."""
    lines = [f"conserved {law}\n" for law in examination.laws]
    undecided = "identifiability of the learned constants could not be decided"
    lines += [f"{undecided}{reason}\n" for reason in reasons(examination)]
    return "".join(lines)


def reasons(examination: Examination) -> list[str]:
    """Why identifiability is not decided, and for which constants."""
    answer = examination.identifiability
    if answer.decided:
        return []
    reached = [name for name in answer.doubtful if name not in answer.faint]
    what = "branches and values" if answer.branched else "values"
    told = [
        (reached, f"it depends on which {what} the data reach"),
        (answer.faint, "effects on what is observed are too small, beside those of others, to be told from rounding"),
    ]
    return [f" for {', '.join(names)}: {reason}" for names, reason in told if names] or [answer.reason]
