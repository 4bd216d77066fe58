"""Kills of training, and whether what they leave can be used, and continued to the same numbers.

    python -m benchmarks.studies.kills --runs 300 -o docs/studies/kills.md
    python -m benchmarks.studies.kills --runs 20 --kinds workers,sweep,crossvalidation,study

Each run is a small fit of two members in a process of its own, which is killed once, then continued by the same call
with `--resume`. A run counts as continued if fit, history and weights equal, bit by bit, those of a run that was not
killed (times apart; the backend is fixed, since with few data `auto` takes the one that is faster at the time). `kill
-9`: at a random moment; `write`: at each step of a write (the file beside, its sync, its renaming), one after the
other, however many --runs says; `INT`, `TERM`, `HUP`: the signal at a random moment; what it leaves must be usable;
`workers`: kill -9 of the parent of two workers, which must end too; the others: kill -9 of the whole command.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

MODEL = "model decay\nstate x\nlearn k = 1 in [0, 5]\nunknown g(x) by mlp(4)\nx' = -k*x + 0.1*g\nobserve x\n"
KINDS = ("kill -9", "write", "INT", "TERM", "HUP")
SLOW = ("workers", "sweep", "crossvalidation", "study")
MARK = "GBSPEC_KILLS"
CASES = """
[case.decay]
title = "decay"
model = "decay"
data = "decay.csv"
[case.decay.training]
members = 2
warm_start = false
method = "lm"
epochs = 6
backend = "torch"
"""


def table() -> str:
    import math

    rows = [
        f"{name},{t / 8},{math.exp(-rate * t / 8)}"
        for name, rate in (("a", 2.0), ("b", 2.2), ("c", 1.8))
        for t in range(9)
    ]
    return "trajectory,t,x\n" + "\n".join(rows) + "\n"


# ---------------------------------------------------------------------------------------------- what is run and killed
def work(kind: str, place: Path, resume: bool) -> None:
    """One call, as the command makes it; the same again with `resume` continues."""
    from gbspec import frontend
    from gbspec.diagnostics import Findings
    from gbspec.operations import fitting, tables
    from gbspec.studies import CrossOptions, StudyOptions, crossvalidate, run_study, study_of
    from gbspec.training import Silent, TrainOptions, points

    inputs, to = place / "inputs", place / "out"
    model = frontend.load_model(inputs / "decay.gb", Findings())
    data = tables.read_data(inputs / "decay.csv", model, Findings())
    workers = 2 if kind == "workers" else 1
    options = TrainOptions(
        members=2, method="lm", epochs=6, warm_start=False, threads=1, workers=workers, resume=resume, backend="torch"
    )
    match kind:
        case "sweep":
            fitting.sweep(model, data, points(["seed=0,5"], options, Findings()), to, options)
        case "crossvalidation":
            crossvalidate(
                model,
                data,
                to,
                TrainOptions(method="lm", epochs=6, warm_start=False, threads=1, workers=1, backend="torch"),
                CrossOptions(),
                lambda fold: Silent(),
            )
        case "study":
            chosen = StudyOptions(workers=2, threads=1, keep_runs=True)
            run_study(study_of([str(inputs / "cases.toml")], chosen), to, chosen, "study", lambda *_: None)
        case _:
            fitting.train(model, data, to, options)


def child(kind: str, place: Path, resume: bool, before: Callable[[], None] = lambda: None) -> int:
    """Forks a process that does the work; returns its id."""
    number = os.fork()
    if number:
        return number
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(os.open(str(place / "stderr"), os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's command in the background ignores it
    for name in ("SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_DFL)
    os.environ[MARK] = str(place)
    status = 0
    try:
        before()
        work(kind, place, resume)
    except KeyboardInterrupt:
        status = 130
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        status = 1
    os._exit(status)


def ended(number: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])


def ends_at(step: int) -> Callable[[], None]:
    """Makes the process end at the nth step of its writes."""

    def patch() -> None:
        left = [step]

        def counted(do: Callable[..., Any]) -> Callable[..., Any]:
            def run(*given: Any, **named: Any) -> Any:
                left[0] -= 1
                if left[0] == 0:
                    os._exit(137)
                return do(*given, **named)

            return run

        tempfile.mkstemp, os.fsync, os.replace = map(counted, (tempfile.mkstemp, os.fsync, os.replace))

    return patch


def marked(place: Path) -> list[int]:
    """Processes that were started for this run and are still there."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={place}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
        except OSError:
            continue
    return [number for number in found if number != os.getpid()]


def gone(place: Path, seconds: float = 20.0) -> bool:
    """Whether no process of a run is left; they may take some time, which a busy machine lengthens."""
    end = time.monotonic() + seconds
    while marked(place):
        if time.monotonic() > end:
            return False
        time.sleep(0.2)
    return True


# ------------------------------------------------------------------------------------------------------------ judgement
def contents(out: Path) -> dict[str, object]:
    """Everything in a directory of runs but times and digests."""
    import csv
    import json

    import numpy as np

    from gbspec.runs import open_run

    found: dict[str, object] = {}
    for path in sorted(out.rglob("*")):
        name = str(path.relative_to(out))
        if path.is_dir() or path.name == ".lock":
            continue
        if path.name == "fit.json":
            run = open_run(path.parent)
            found[name] = _without_times(json.loads(path.read_text()))
            found[name + " weights"] = [
                {key: np.asarray(value).tobytes() for key, value in member.weights.items()} for member in run.members
            ]
        elif path.suffix == ".csv":
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            found[name] = [{k: v for k, v in row.items() if "seconds" not in k and k != "resumed"} for row in rows]
        elif path.suffix == ".json":
            found[name] = _without_times(json.loads(path.read_text()))
        else:
            found[name] = None if path.suffix in (".safetensors", ".md") else path.read_bytes()
    return found


TIMES = {
    *("seconds", "files", "cpu_seconds", "wall_seconds", "other_cpu_seconds", "finished", "last", "resumed"),
    *("path", "absolute", "relative"),  # of the table, which lies in the folder of the run
}


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_times(v) for k, v in value.items() if k not in TIMES or (k == "finished" and v in (0, 1))}
    return [_without_times(one) for one in value] if isinstance(value, list) else value


def usable(out: Path) -> bool:
    """Whether every run with weights opens and predicts; raises what is wrong."""
    from gbspec.diagnostics import UserError
    from gbspec.runs import open_run

    opened = False
    for path in sorted(out.rglob("fit.json")):
        if any(path.parent.glob("members/*/weights.safetensors")):
            run = open_run(path.parent)
            assert run.best in run.numbers and len(run.fit.members) == len(run.numbers)
            assert all(member.rhs(0.0, [0.5]) is not None for member in run.members)
            opened = True
        else:
            try:
                open_run(path.parent)
            except UserError as error:
                assert {d.code for d in error.diagnostics} <= {"GB853"}, error
    return opened


class FailedError(Exception):
    """What a kill left cannot be used or continued."""


def one(kind: str, number: int, seconds: float, steps: int, whole: dict[str, object], keep: Path) -> dict[str, bool]:
    """One run, killed once and continued; says what of it held."""
    chance = random.Random(f"{kind} {number}")
    place = Path(tempfile.mkdtemp(prefix="kills-"))
    prepared(place)
    before = ends_at(1 + number % steps) if kind == "write" else lambda: None
    process = child(kind, place, False, before)
    if kind != "write":
        time.sleep(chance.uniform(0, seconds))
        os.kill(process, getattr(signal, f"SIG{kind}", signal.SIGKILL))
    status = ended(process)
    said = {"killed": status not in (0, 1), "workers left": not gone(place)}
    if status == 1:
        raise FailedError(f"{place}: the first call failed: {(place / 'stderr').read_text()[-500:]}")
    said["usable"] = usable(place / "out")
    begun = (place / "out").is_dir()  # a signal may come before there is a run
    if kind in KINDS[2:] and status == 130 and begun and not said["usable"]:
        raise FailedError(f"{place}: {kind} left no weights")
    status = ended(child(kind, place, begun))
    if status:
        raise FailedError(f"{place}: not continued: {(place / 'stderr').read_text()[-500:]}")
    if contents(place / "out") != whole:
        raise FailedError(f"{place}: other numbers")
    import shutil

    shutil.rmtree(place)
    return said


def prepared(place: Path) -> None:
    (place / "inputs").mkdir(parents=True)
    (place / "inputs" / "decay.gb").write_text(MODEL)
    (place / "inputs" / "decay.csv").write_text(table())
    (place / "inputs" / "cases.toml").write_text(CASES)


def reference(kind: str) -> tuple[float, int, dict[str, object]]:
    """A run that is not killed: its seconds, the steps of its writes, its content."""
    place = Path(tempfile.mkdtemp(prefix="kills-"))
    prepared(place)
    began = time.monotonic()
    if ended(child(kind, place, False)):
        raise FailedError(f"{kind} without a kill: {(place / 'stderr').read_text()[-800:]}")
    seconds = time.monotonic() - began
    steps = 0
    if kind == "write":
        low, high = 1, 4096  # the number of steps, by bisection: a run with more ends by itself
        while low < high:
            middle = (low + high) // 2
            tried = Path(tempfile.mkdtemp(prefix="kills-"))
            prepared(tried)
            low, high = (low, middle) if ended(child(kind, tried, False, ends_at(middle))) == 0 else (middle + 1, high)
        steps = low - 1
    return seconds, steps, contents(place / "out")


def main() -> int:
    """Runs the campaign and prints (or writes) the table; status 1 if a run could not be continued."""
    parser = argparse.ArgumentParser(description="Kills of training, and what they leave.")
    parser.add_argument("--runs", type=int, default=300, help="runs of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first run; a number always does the same")
    parser.add_argument("--kinds", default=",".join(KINDS), help=", ".join((*KINDS, *SLOW)))
    parser.add_argument("-o", "--output", type=Path, help="a table in Markdown, to which rows are added")
    options = parser.parse_args()
    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    import torch

    import gbspec.training.runs.member as member

    torch.set_num_threads(1)
    member.SAVE_EVERY, member.SAVING_SHARE = 0.0, 1e9  # a save after every iteration: many more writes to be killed at
    rows, status = [], 0
    for kind in options.kinds.split(","):
        seconds, steps, whole = reference(kind)
        print(f"{kind}: {seconds:.1f} s without a kill, {steps} steps of writes", flush=True)
        counts: Counter[str] = Counter()
        numbers = range(options.first, steps if kind == "write" else options.first + options.runs)
        for number in numbers:
            try:
                said = one(kind, number, seconds, max(steps, 1), whole, Path())
                counts.update(["continued", *(name for name, holds in said.items() if holds)])
            except FailedError as failure:
                status = 1
                counts["failed"] += 1
                print(kind, number, failure, flush=True)
            except Exception as error:
                status = 1
                counts["failed"] += 1
                print(kind, number, type(error).__name__, error, flush=True)
        rows.append(
            f"| {kind} | {len(numbers)} | {counts['killed']} | {counts['usable']} | {counts['continued']} | "
            f"{counts['workers left']} |"
        )
        print(rows[-1], flush=True)
    if options.output is not None:
        write(options.output, rows)
    return status


HEAD = """# Kills

`python -m benchmarks.studies.kills --runs N --kinds KIND,...`: a fit of two members is killed once and continued by the
same call with `--resume`. *ended early*: the kill came before the end; *usable*: `open_run` gave at least one member's
weights right after it; *continued*: fit, history and weights equal, bit by bit, those of a run that was not killed.

| kind | runs | ended early | usable before it was continued | continued | processes left |
|---|---:|---:|---:|---:|---:|
"""


def write(path: Path, rows: list[str]) -> None:
    known = path.read_text().splitlines() if path.is_file() else HEAD.splitlines()
    names = {row.split("|")[1] for row in rows}
    kept = [line for line in known if not line.startswith("| ") or line.split("|")[1] not in names]
    path.write_text("\n".join([*kept, *rows]) + "\n")


def _defined() -> NoReturn:
    raise SystemExit(main())


if __name__ == "__main__":
    _defined()
