"""`gbspec demo`: simulation, training and validation on a model with a known truth."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.json_values import JsonObject
from gbspec.report import number, run_summary, table

if TYPE_CHECKING:
    from gbspec.analysis import Validation
    from gbspec.diagnostics import Findings
    from gbspec.runs import Run
    from gbspec.training import TrainOptions

MODEL = "urp_gb2"
ROWS = (
    ("solution", "solution"),
    ("rhs", "right-hand side"),
    ("functions", "kinetic function"),
    ("constants", "constants"),
)
"""Metrics of the validation and their names in the table."""


@command("demo", "gbspec demo", "gbspec demo -o /tmp/demo --seed 3")
def run(
    output: Output,
    to: Annotated[str, typer.Option("--output", "-o", help="The folder to write into.", metavar="DIR")] = "demo",
    seed: Annotated[int, typer.Option("--seed", help="Seed of data and training.", min=0)] = 0,
) -> None:
    """Simulate a reactor, learn its unknown kinetics and constants from the data, and show the results."""
    from gbspec.operations import reporting, tables
    from gbspec.report import save

    began = time.monotonic()
    folder = Path(to)
    data, directory, picture = folder / f"{MODEL}.csv", folder / f"{MODEL}_run", folder / f"{MODEL}.png"
    _prepare(folder, directory)
    published, options = _simulate(output, data, seed)
    made, found = _learn(output, data, directory, options)
    save(reporting.figure("summary", made, tables.training_data(made, _findings())), picture)
    seconds = time.monotonic() - began
    errors = _errors(found)
    output.result(f"\n{run_summary(made)}\n\n{_comparison(errors, published)}\n")
    output.result(f"picture: {picture}   run: {directory}   data: {data}   ({seconds:.0f} s)")
    output.summary("next: " + "\n      ".join(next_commands(directory)))
    output.document(
        {
            "seconds": seconds,
            "errors": errors,
            "published": dict(published),
            "constants": made.fit.to_json()["constants"],
            "picture": picture,
            "run": directory,
            "data": data,
        }
    )


def _findings() -> Findings:
    from gbspec.diagnostics import Findings

    return Findings()


def _prepare(folder: Path, directory: Path) -> None:
    """Creates the folder and removes the run of an earlier demo; other files there are an error (GB802, GB806)."""
    if folder.exists() and not folder.is_dir():
        message = f"`{folder}` is a file; the demo needs a folder"
        raise UserError([Diagnostic("GB802", message, None, help="choose another with `-o`")])
    folder.mkdir(parents=True, exist_ok=True)
    if directory.exists():
        if not (directory / "model.gb").is_file():
            message = f"`{directory}` exists and is not the run of an earlier demo"
            raise UserError([Diagnostic("GB806", message, None, help="choose another folder with `-o`")])
        shutil.rmtree(directory)


def _simulate(output: Output, data: Path, seed: int) -> tuple[dict[str, float], TrainOptions]:
    """Writes the table; returns the published errors and the training options of the case."""
    from dataclasses import replace

    from gbspec.data import find_cases, shipped_model, write
    from gbspec.operations import models, tables
    from gbspec.training import TrainOptions

    path = shipped_model(MODEL)
    case = find_cases(path).of_model(MODEL)
    source = models.subject(path, {}, _findings())
    output.say(f"{MODEL}: {case.title}")
    with output.bar("simulating") as advance:
        made = tables.simulate(source, replace(case.sampling, seed=seed), None, advance)
    write(data, made, source.model)
    output.say(f"simulated {len(made)} trajectories, {made.measurements} values at irregular times: {data}")
    return dict(case.published), TrainOptions(max_step=case.training.max_step, seed=seed)


def _learn(output: Output, data: Path, directory: Path, options: TrainOptions) -> tuple[Run, Validation]:
    """Trains and validates."""
    from gbspec import frontend
    from gbspec.cli.progress import shown
    from gbspec.operations import analysing, fitting, tables

    findings = _findings()
    output.say("learning the kinetics phi(x1, x2, Da) and the constants B and beta")
    model = frontend.load_model(MODEL, findings)
    measured = tables.read_data(data, model, findings)
    with shown(output) as progress:
        made = fitting.train(model, measured, directory, options, progress)
    output.say("validating against the truth")
    return made, analysing.validate(made, measured)


def _errors(found: Validation) -> dict[str, float | None]:
    """The L2 error of each metric; for constants the mean relative error."""
    truth: JsonObject = found.to_json().get("truth", {})  # type: ignore[assignment]  # its keys are the contract's
    functions = truth.get("functions", {})
    over_all: JsonObject = functions.get("all") or next(iter(functions.values()), {})
    return {
        "solution": truth.get("solution", {}).get("L2"),
        "rhs": truth.get("rhs", {}).get("L2"),
        "functions": over_all.get("L2"),
        "constants": truth.get("constants", {}).get("all"),
    }


def _comparison(errors: dict[str, float | None], published: dict[str, float]) -> str:
    rows = []
    for key, word in ROWS:
        mine, theirs = errors.get(key), published.get(key)
        times = f"{theirs / mine:.0f}" if mine and theirs and mine < theirs else "-"
        rows.append((word, number(mine, 3), number(theirs, 3), times))
    return table(("error against the truth", "this run", "published", "smaller by a factor of"), rows)


def next_commands(directory: Path) -> tuple[str, ...]:
    """Three commands to try next, as they can be typed here."""
    program = typed(sys.argv[0])
    return (
        f"{program} report {directory}",
        f"{program} bifurcate {directory} --over Da --range 0.2 0.5 --cycles -o diagram.png",
        f"{program} new my_model",
    )


def typed(called: str) -> str:
    """How gbspec can be called from here: by its name if that is on the path, else by the path with which it was."""
    if shutil.which("gbspec"):
        return "gbspec"
    path = Path(called)
    if path.stem != "gbspec" or not path.is_file():
        return "python -m gbspec"
    try:
        near = os.path.relpath(path)
    except ValueError:  # on another drive
        near = str(path)
    return shlex.quote(min(near, str(path), key=len))
