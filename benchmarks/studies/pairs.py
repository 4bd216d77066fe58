"""What can be combined: every pair of statements in one small model, and every statement with every command.

    python -m benchmarks.studies.pairs -o docs/studies/pairs.md
    python -m benchmarks.studies.pairs -o docs/studies/pairs.md --blanks    (what the page does not say yet)
    python -m benchmarks.studies.pairs --only events,dose        (rows and columns that begin with these words)

Each pair of `STATEMENTS` is put into a model of one state, which is checked; then a training with a table of three
trajectories is prepared up to its first iteration (`--fit`: with one iteration). Offered means that no error comes;
else the code of the first one stands there. Commands run with a run of one iteration. Another kind of statement is one
line of `STATEMENTS`.
"""

from __future__ import annotations

import argparse
import itertools
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gbspec.data import Trajectories
    from gbspec.ir import Model
    from gbspec.training import TrainOptions

ROWS = 8


@dataclass(frozen=True)
class Statement:
    """Lines that a model gets, a summand of the balance of `x`, and columns of the table with the value in each row."""

    lines: str
    summand: str = ""
    columns: Mapping[str, str] = field(default_factory=dict)


STATEMENTS = {
    "unknown": Statement("unknown f(x) by mlp(2)", "0.1*f"),
    "unknown by spline": Statement("unknown j(x in [0, 2]) by spline(6)", "0.1*j"),
    "unknown with contracts": Statement("unknown g(x) >= 0, zero at x = 0, increasing in x by mlp(2)", "-0.1*g"),
    "learn with prior": Statement("learn a = 0.1 prior normal(0.1, 0.02)", "-a*x"),
    "learn, a row": Statement("learn r[1..2] = 0.1 in [0, 1]", "-r[1]*r[2]*x"),
    "learn per trajectory": Statement("learn p = 0.1 in [0.01, 1] per trajectory", "-p*x"),
    "learn per trajectory ~": Statement("learn q = 0.1 in [0.01, 1] per trajectory ~ lognormal(0.2)", "-q*x"),
    "learn per column ~": Statement(
        "learn i = 0.1 in [0.01, 1] per trajectory ~ lognormal(0.2) per strain ~ lognormal(0.1)",
        "-i*x",
        {"strain": "{strain}"},
    ),
    "effect": Statement("effect e per trajectory\nunknown h(x in [0, 2], e in [-3, 3]) by mlp(2)", "0.1*h(x, e)"),
    "noise, learned": Statement("learn s = 0.1 in [0.01, 1]\nobserve y1 = 2*x noise normal(s)", "", {"y1": "{v2}"}),
    "noise, stated": Statement("observe y2 = 3*x noise normal(0.1)", "", {"y2": "{v3}"}),
    "noise lognormal": Statement("observe y3 = 4*x noise lognormal(0.1)", "", {"y3": "{v4}"}),
    "noise student": Statement("observe y5 = 5*x noise student(0.1, 5)", "", {"y5": "{v5}"}),
    "observe x'": Statement("observe y4 = x'", "", {"y4": "{slope}"}),
    "condition": Statement("condition c in [0, 1]", "-0.1*c*x", {"c": "0.5"}),
    "input": Statement("input u held in [0, 1]", "0.1*u", {"u": "{number}"}),
    "input linear": Statement("input o linear in [0, 1]", "0.1*o", {"o": "{number}"}),
    "table": Statement("table known(v) = (-9, 0), (0, 0), (2, 0.2), (9, 0.3)", "-known(x)"),
    "dose": Statement("state d in [0, 9]\nd' = -d\ninitial d = 0\ndose d", "0.1*d", {"dose_d": "{dose}"}),
    "dose over": Statement("state w in [0, 9]\nw' = -w\ninitial w = 0\ndose w over 0.3", "0.1*w", {"dose_w": "{dose}"}),
    "dose, learned lag": Statement(
        "state l in [0, 9]\nl' = -l\ninitial l = 0\nlearn late = 0.1 in [0, 0.3]\ndose l lag late",
        "0.1*l",
        {"dose_l": "{dose}"},
    ),
    "diffusion": Statement("diffusion x = 0.1"),
    "event at a time": Statement("discrete on = 1\nevent stop at 0.7: on = 0", "-0.1*on*x"),
    "event when": Statement("discrete low = 0\nevent fall when x <= 0.8: low = 1", "0.01*low"),
    "event, state reset": Statement("event refill when x <= 0.3: x = x + 0.2"),
    "event after": Statement("discrete past = 0\nevent wait when x <= 0.8 after 0.15: past = x", "0.01*past"),
    "event, transient": Statement(
        "discrete held = 0\nevent brief when x <= 0.8 after 0.15 transient: held = x", "0.01*held"
    ),
    "event, queue": Statement("event pulses when sin(12*t) > 0.5 after 0.6 queue 3: x = x + 0.01"),
    "event, sampled": Statement(
        "discrete seen = 0\nevent look when x <= 0.8 after 0.15 sampled: seen = x", "0.01*seen"
    ),
    "algebraic, a search": Statement("algebraic v in [0, 3] = 0.5\nequation root: v^3 + v = x", "-0.1*v"),
    "algebraic, a formula": Statement("algebraic rr in [0, 9]\nequation rate: rr = 0.2*x/(1 + x)", "-0.1*rr"),
    "delay": Statement("", "-0.1*delay(x, 0.3)"),
    "delay, learned": Statement("learn tau = 0.3 in [0.1, 0.5]", "-0.1*delay(x, tau)"),
    "history": Statement("history x = 0.9", "-0.1*delay(x, 0.25)"),
    "array of states": Statement("state n[1..3] in [0, 2]\nn[i]' = 1 - n[i]\ninitial n[i] = 0.5", "0.01*n[2]"),
    "process": Statement("state b in [0, 9]\nprocess loss: b -> rate 0.1*b\nb' = net(b)\ninitial b = 1", "0.01*b"),
    "hidden state": Statement("state z in [0, 2]\nz' = -z", "0.1*z"),
    "initial": Statement("learn start = 1 in [0.5, 2]\ninitial x = start"),
    "initial steady": Statement("initial steady", "0.6"),
    "time from": Statement("time t from 0"),
    "conserve": Statement(
        "state m1 = 1\nstate m2 = 0\nm1' = -m1\nm2' = m1\ninitial m1 = 1\ninitial m2 = 0\nconserve m = m1 + m2"
    ),
    "units and `in`": Statement("const half = 50 in percent", "-0.001*x*(half in 1)"),
    "column sd": Statement("", "", {"sd_x": "0.05"}),
    "censored values": Statement("", "", {"limit_x": "{limit}"}),
    "truth": Statement("truth k = 0.6"),
}

CHEAP, LIKELIHOOD = "--method lm --epochs 1", "--effort low"
"""Options of trainings: one iteration of least squares, and where only the likelihood is maximised."""
AGREE = 1e-3
"""The largest difference, in ranges of the states, between a solution of the training and an adaptive one."""

COMMANDS = {
    "train, a tolerance": "train m.gb t.csv -o again {cheap} --tolerance 1e-4 --backend torch",
    "train, stiff solver": "train m.gb t.csv -o again {cheap} --solver ros34pw2 --backend torch",
    "train, kernel": "train m.gb t.csv -o again {cheap} --backend native",
    "evaluate": "evaluate run t.csv",
    "validate": "validate run",
    "predict": "predict run t.csv -o p.csv",
    "simulate": "simulate run -o s.csv --like t.csv",
    "plot fit": "plot run fit -o f.png",
    "report": "report run",
    "profile": "profile run k -o k.png --points 2",
    "eigen": "eigen run --along t.csv",
    "bifurcate": "bifurcate run --over k --range 0.4 0.8 -o b.png",
    "crossvalidate": "crossvalidate m.gb t.csv -o cv {cheap} --folds 2 --backend torch",
    "compile": "compile run -o m.py",
    "compile latex": "compile m.gb --emit latex -o m.tex",
    "compile native": "compile m.gb --emit native -o m.c",
    "export c": "export run -o c --as c --no-verify",
    "export fmu": "export run -o m.fmu --as fmu --no-verify",
    "export onnx": "export run -o o --as onnx --no-verify",
}


def model(chosen: Sequence[Statement]) -> str:
    """The text of a model with these statements."""
    lines = ["model m", *(line for one in chosen for line in one.lines.splitlines())]
    terms = " + ".join(f"({one.summand})" for one in chosen if one.summand)
    start = [] if any("initial x" in one.lines for one in chosen) else ["state x in [0, 2] = 1"]
    if not start:
        start = ["state x in [0, 2]"]
    return (
        "\n".join(
            [*lines, *start, "learn k = 0.5 in [0.1, 2]", f"x' = -k*x{' + ' + terms if terms else ''}", "observe x"]
        )
        + "\n"
    )


def table(chosen: Sequence[Statement]) -> str:
    """A table with the columns that these statements need."""
    import math

    columns = {name: cell for one in chosen for name, cell in one.columns.items()}
    rows = [",".join(["trajectory", "t", "x", *columns])]
    for number in range(3):
        for row in range(ROWS):
            t = 0.2 * row
            value = (1 + 0.1 * number) * math.exp(-0.6 * t) + 0.01 * math.sin(9 * t + number)
            cells = {
                **{f"v{n}": f"{n * value:.5f}" for n in (2, 3, 4, 5)},
                "slope": f"{-0.6 * value:.5f}",
                "strain": f"{number % 2}",
                "number": f"{0.1 * number}",
                "dose": "1" if row == 1 else "",
                "limit": "-1" if row == ROWS - 1 else "",
            }
            given = [cell.format(**cells) for cell in columns.values()]
            rows.append(",".join([f"{number}", f"{t:.1f}", f"{value:.5f}", *given]))
    return "\n".join(rows) + "\n"


def tried(chosen: Sequence[Statement], folder: Path, fit: bool) -> str:
    """Empty if a model with these statements is checked and its training begun; else the code of the first error."""
    from gbspec import frontend
    from gbspec.diagnostics import ComputationError, Findings, UserError
    from gbspec.operations import fitting, tables
    from gbspec.passes import examine
    from gbspec.training import TrainOptions

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "m.gb").write_text(model(chosen))
    (folder / "t.csv").write_text(table(chosen))
    try:
        findings = Findings()
        made = frontend.load_model(folder / "m.gb", findings)
        examine(made, findings)
        findings.raise_if_failed()
        data = tables.read_data(folder / "t.csv", made, findings)
        findings.raise_if_failed()
        options = TrainOptions(
            epochs=1,
            effort="low",
            half_step=False,
            warm_start=False,
            backend="torch",
            threads=1,
            workers=1,
            max_step=0.2,
        )
        if fit:
            one = options if made.marginal or made.diffusions else replace(options, method="lm")
            fitting.train(made, data, folder / "run", one)
        else:
            prepare(made, data, options, folder / "run")
    except UserError as error:
        return error.diagnostics[0].code
    except ComputationError:
        return "fails"
    return ""


def prepare(made: Model, data: Trajectories, options: TrainOptions, folder: Path) -> None:
    """Prepares a training up to its first iteration; raises what `train` would."""
    from gbspec.backends import load_module
    from gbspec.ir import METHODS
    from gbspec.training import Silent
    from gbspec.training.recipe import build_context, plan
    from gbspec.training.runs.fit import Fitting

    Fitting(made, data, options, folder, Silent())
    context = build_context(made, load_module(made, METHODS["rk4"]), data, options, options.seed)
    plan(context, context.parameters({}))


def commanded(command: str, folder: Path) -> str:
    """Empty if a command ends with 0 in a folder with a model, a table and a run; else its first code or status.

    `differs` where `validate` finds another solution by its adaptive solver than that of the training.
    """
    import re

    from typer.testing import CliRunner

    from gbspec.cli.app import build, needed

    for name in ("again", "cv"):
        shutil.rmtree(folder / name, ignore_errors=True)
    before = Path.cwd()
    os.chdir(folder)
    try:
        words = command.split()
        result = CliRunner().invoke(build(needed(words)), words)
    finally:
        os.chdir(before)
    found = re.search(r"error\[(GB\d+)\]", result.stderr)
    if result.exit_code != 0:
        return found[1] if found else f"status {result.exit_code}"
    apart = re.search(r"adaptive ([\d.e+-]+)", result.stdout) if command.startswith("validate") else None
    return "differs" if apart is not None and float(apart[1]) > AGREE else ""


def all_commands(name: str, folder: Path) -> Iterable[tuple[str, str]]:
    """Each command with what comes of it for one statement; a refused training refuses what needs a run."""
    refused = tried([STATEMENTS[name]], folder, True)
    for command, call in COMMANDS.items():
        if refused and " run " in f"{call} ":
            yield command, refused
            continue
        found = commanded(call.format(cheap=CHEAP), folder)
        if found == "GB770" and "{cheap}" in call:
            found = commanded(call.format(cheap=LIKELIHOOD), folder)
        yield command, found


def matrix(rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], str]) -> Iterable[str]:
    """The lines of a table whose columns are numbered."""
    yield f"| | {' | '.join(str(i) for i in range(1, len(columns) + 1))} |"
    yield "|---" * (len(columns) + 1) + "|"
    for i, row in enumerate(rows, start=1):
        shown = [cells.get((row, column), "·") or "+" for column in columns]
        yield f"| {i} {row} | {' | '.join(shown)} |"


def text(pairs: Mapping[tuple[str, str], str], commands: Mapping[tuple[str, str], str], chosen: Sequence[str]) -> str:
    """The page."""
    named = [
        f"| {i} | {name} | `{STATEMENTS[name].lines.splitlines()[-1] if STATEMENTS[name].lines else 'a column'}` |"
        for i, name in enumerate(chosen, 1)
    ]
    calls = [
        f"| {i} | {name} | `gbspec {call.format(cheap=CHEAP)}` |" for i, (name, call) in enumerate(COMMANDS.items(), 1)
    ]
    refused = sum(1 for code in pairs.values() if code)
    return "\n".join(
        [
            "# What can be combined",
            "",
            "`python -m benchmarks.studies.pairs -o docs/studies/pairs.md` tries each pair of statements in a",
            "model of one state: `check`, then `train` up to its first iteration. `+`: offered; a code: refused,",
            "for the reason that `gbspec explain CODE` gives; `·`: not tried. [Limits](../limits.md) says the",
            "same in words. Commands are tried with a run of one iteration; where training takes no",
            f"`--method lm`, with one of `{LIKELIHOOD}`. `validate` also compares the solution of the training",
            "with that of the adaptive solver: `differs` would stand where they are not the same.",
            "",
            f"## Statement by statement: {len(pairs) - refused} of {len(pairs)} pairs are offered",
            "",
            *matrix(chosen, chosen, pairs),
            "",
            "| | statement | as tried |",
            "|---|---|---|",
            *named,
            "",
            "## Statement by command",
            "",
            *matrix(chosen, list(COMMANDS), commands),
            "",
            "| | command | as tried |",
            "|---|---|---|",
            *calls,
            "",
        ]
    )


def written(page: str, columns: Sequence[str]) -> dict[tuple[str, str], str]:
    """The cells of a page's matrix with these columns that were tried, by the words of rows and columns."""
    import re

    head = f"| | {' | '.join(str(i) for i in range(1, len(columns) + 1))} |\n"
    found = {}
    for line in page.partition(head)[2].splitlines()[1:]:
        row = re.fullmatch(r"\| \d+ ([^|]+) \| (.+) \|", line)
        if row is None:
            break
        cells = zip(columns, row[2].split(" | "), strict=True)
        found |= {(row[1], column): cell.removeprefix("+") for column, cell in cells if cell != "·"}
    return found


def main() -> int:
    """Tries all and writes the page; status 1 if anything ends as a defect."""
    parser = argparse.ArgumentParser(description="What can be combined.")
    parser.add_argument("--only", default="", help="statements that begin with these words")
    parser.add_argument("--fit", action="store_true", help="train each pair for one iteration")
    parser.add_argument("--no-commands", action="store_true", help="pairs alone")
    parser.add_argument("--blanks", action="store_true", help="try only what the page of -o does not have")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    wanted = tuple(options.only.split(","))
    chosen = [name for name in STATEMENTS if name.startswith(wanted)]
    place = Path(tempfile.mkdtemp(prefix="pairs-"))
    page = options.output.read_text(encoding="utf-8") if options.blanks else ""
    pairs, commands = written(page, chosen), written(page, list(COMMANDS))

    def write() -> None:
        if options.output is not None:
            options.output.write_text(text(pairs, commands, chosen), encoding="utf-8")

    for first, second in itertools.combinations_with_replacement(chosen, 2):
        if (first, second) in pairs:
            continue
        tested = [STATEMENTS[name] for name in dict.fromkeys((first, second))]
        pairs[first, second] = tried(tested, place / "two", options.fit)
        print(first, "|", second, "|", pairs[first, second] or "+", flush=True)
        write()
    for name in [] if options.no_commands else chosen:
        if all((name, command) in commands for command in COMMANDS):
            continue
        for command, code in all_commands(name, place / "one"):
            commands[name, command] = code
            print(name, "|", command, "|", code or "+", flush=True)
        write()
    write()
    shutil.rmtree(place, ignore_errors=True)
    return int(any(code in ("fails", "differs", "status 70") for code in (*pairs.values(), *commands.values())))


if __name__ == "__main__":
    raise SystemExit(main())
