"""`gbspec study CASES -o DIR`: fits the cases of a `cases.toml` repeatedly and compares errors with published ones."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.report import number
from gbspec.runs import files
from gbspec.studies import StudyOptions

if TYPE_CHECKING:
    from gbspec.studies import Record


@command(
    "study",
    "gbspec study urp -o urp_study",
    "gbspec study urp bf -o both --members 3 --workers 2",
    "gbspec study urp:URP_GB2 -o noisy --noise 0.05 --effort high",
    "gbspec study my_folder/cases.toml -o my_study --case A --case B",
)
def run(
    output: Output,
    cases: Annotated[
        list[str],
        typer.Argument(
            help="A cases.toml, or a folder of bundled models; `urp:A,B` selects cases.", metavar="CASES..."
        ),
    ],
    to: Annotated[str, typer.Option("--output", "-o", help="The directory of the study.", metavar="DIR")],
    options: StudyOptions,
) -> None:
    """Fit the cases of a `cases.toml` several times and compare their errors with the published ones.

    The directory contains `table.md`, `results.csv` (one row for each member) and `study.json`, updated after each
    member. The same command continues an interrupted study; finished members are not fitted again.
    """
    from gbspec.studies import Task, run_study, study_of

    study = study_of(cases, options)
    root = directory(to)

    def told(task: Task, record: Record, done: int, total: int) -> None:
        output.say(f"[{done}/{total}] {task.name}: {line(record)}")

    made_by = shlex.join(["gbspec", "study", *cases, "-o", to, *options.flags()])
    summary = run_study(study, root, options, made_by, told)
    output.say(f"wrote {root / 'table.md'}")
    output.result((root / "table.md").read_text(encoding="utf-8").rstrip("\n"))
    output.document(summary.to_json())


def directory(to: str) -> Path:
    """The study's directory; raises `UserError` (GB802, GB806) if it is something else."""
    root = Path(to)
    if root.exists() and not root.is_dir():
        message = f"`{to}` is a file; a study needs a directory"
        raise UserError([Diagnostic("GB802", message, None, help="choose another name")])
    if root.is_dir() and not files.is_blank(root) and not (root / "study.json").is_file():
        message = f"`{to}` already exists and is not a study"
        raise UserError([Diagnostic("GB806", message, None, help="choose another name")])
    return root


def line(record: Record) -> str:
    """The result of a member in one line."""
    found = record.fitted
    if found is None:
        return f"failed: {record.failure}"
    errors = [f"{name} {number(entry['L2'], 3)}" for name, entry in found.errors.items()]
    warned = ["step warned"] if found.step_warning else []
    return ", ".join([*errors, *warned, f"CPU {found.cpu_seconds:.0f} s"])
