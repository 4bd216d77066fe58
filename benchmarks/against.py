"""The same work in this checkout and in another one (an older commit), as ratios of processor time.

    git worktree add ../old COMMIT && python -m benchmarks.against ../old [--rounds 9] [--starts 7] [--processes 3]
    python -m benchmarks.against ../old --only "step, native"

A worker process for each checkout imports the benchmarks of that checkout and keeps its workload (that of
`benchmarks.step`). Both are called in turn, the first of a pair drawn at random, and the ratio is taken within the
pair. Where memory lies differs from process to process, and moves times by several per cent for as long as a process
lives. So both workers are restarted several times, and each start gives one ratio, the median of its pairs.
Commands run as processes in pairs too. The interval of a median ratio holds with at least 95 % (order
statistics; Conover 1999, section 3.2), or is the range of all ratios where these are fewer than six.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median

from scipy.stats import binom

from benchmarks.harness import markdown, parser, processor_seconds, say, write

HERE = Path(__file__).resolve().parents[1]

WORKER = """
import sys, json, re, torch
from benchmarks.harness import clock
from benchmarks.second_order import variants
from benchmarks.variants import build
from benchmarks.workload import Size, make
torch.set_num_threads(1)
work = make(Size(trajectories=int(sys.argv[1])))
wanted = lambda *names: any(re.search(sys.argv[2], name) for name in names)
built = [kind for kind in ("native", "graph") if wanted(f"step, {kind} float64", f"step, {kind} float32")]
runs = {f"step, {c.label}": c.run for c in build(work, built, ["float64", "float32"])} if built else {}
if wanted("Jacobian, kernel", "Jacobian, graph", "step, sketch", "step, factors"):
    runs |= variants(work)
runs = {name: run for name, run in runs.items() if wanted(name)}
for run in runs.values():
    run()
print(json.dumps(list(runs)), flush=True)
for line in sys.stdin:
    print(clock(runs[line.strip()])[1], flush=True)
"""
"""Times the functions that both checkouts' benchmarks offer, by name."""

TRAINING = ["train", "urp_gb2", "{data}", "-o", "{out}", "--effort", "low", "--quiet"]
COMMANDS: Mapping[str, Sequence[str]] = {
    "`gbspec --version`": ["--version"],
    "`gbspec check urp_gb2`": ["check", "urp_gb2"],
    "`gbspec compile urp_gb2`": ["compile", "urp_gb2", "-o", "{out}.py"],
    "a fit, 40 trajectories, `--effort low`": [*TRAINING, "--members", "1"],
    "an ensemble of four, two workers": [*TRAINING, "--members", "4", "--workers", "2"],
}
SHORT = 3
"""The number of commands above that take a second: these are repeated as often as the functions."""


class Worker:
    """A checkout's process, which times its functions whose names contain the regular expression `only`."""

    def __init__(self, tree: Path, trajectories: int = 200, only: str = "") -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", WORKER, str(trajectories), only],
            cwd=tree,
            env=environment(tree),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self.names: list[str] = json.loads(self._line())

    def _line(self) -> str:
        if self.process.stdout is None or not (line := self.process.stdout.readline()):
            raise SystemExit("a worker ended; run `python -m benchmarks.second_order` in both checkouts to see why")
        return line

    def end(self) -> None:
        """Ends the process."""
        if self.process.stdin is not None:
            self.process.stdin.close()
        self.process.wait()

    def seconds(self, name: str) -> float:
        """Processor time of one call of a function."""
        if self.process.stdin is not None:
            self.process.stdin.write(name + "\n")
            self.process.stdin.flush()
        return float(self._line())


def environment(tree: Path) -> dict[str, str]:
    """The environment in which `import gbspec` and `import benchmarks` find those of a checkout."""
    return os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}


def command_seconds(tree: Path, arguments: Sequence[str], data: Path, folder: Path) -> float:
    """Processor time of a command with the `gbspec` of a checkout, with all its workers; it writes to a new folder."""
    with tempfile.TemporaryDirectory(dir=folder) as fresh:
        filled = [text.format(data=data, out=Path(fresh) / "out") for text in arguments]
        before = processor_seconds()
        called = [sys.executable, "-m", "gbspec", *filled]
        subprocess.run(called, check=True, capture_output=True, cwd=tree, env=environment(tree))
        return processor_seconds() - before


def pairs(one: Callable[[], float], other: Callable[[], float], rounds: int) -> list[tuple[float, float]]:
    """Times both in turn, the first of each pair drawn at random, after one untimed call of each."""
    one(), other()
    found = []
    for _ in range(rounds):
        if random.random() < 0.5:
            mine = one()
            found.append((mine, other()))
        else:
            theirs = other()
            found.append((one(), theirs))
    return found


def interval(values: Sequence[float], level: float = 0.95) -> tuple[float, float]:
    """An interval of the median by order statistics; the range of all values where they are too few for the level."""
    ordered, n = sorted(values), len(values)
    rank = max(int(binom.ppf((1 - level) / 2, n, 0.5)), 1)
    return ordered[rank - 1], ordered[n - rank]


def row(name: str, found: Sequence[tuple[float, float]]) -> list[str]:
    """Medians of both, and of the ratio with its interval."""
    ratios = [mine / theirs for mine, theirs in found]
    low, high = interval(ratios)
    times = [f"{1e3 * median(each):.4g} ms" for each in zip(*found, strict=True)]
    return [name, times[1], times[0], f"{median(ratios):.3f}", f"{low:.3f} to {high:.3f}", str(len(found))]


def functions(other: Path, options: argparse.Namespace) -> dict[str, list[tuple[float, float]]]:
    """For each function, a pair (this checkout, the other one) from each start of both workers.

    The seconds of a start are those of the pair whose ratio is the median one of its rounds.
    """
    found: dict[str, list[tuple[float, float]]] = {}
    for start in range(options.starts):
        here, there = (Worker(tree, only=options.only) for tree in (HERE, other))
        for name in here.names:
            say(f"{name}, start {start + 1} of {options.starts}")
            timed = pairs(partial(here.seconds, name), partial(there.seconds, name), options.rounds)
            ordered = sorted(timed, key=lambda pair: pair[0] / pair[1])
            found.setdefault(name, []).append(ordered[len(ordered) // 2])
        for worker in (here, there):
            worker.end()
    return found


def commands(other: Path, options: argparse.Namespace, folder: Path) -> dict[str, list[tuple[float, float]]]:
    """Pairs of processor seconds of commands."""
    found, data = {}, folder / "data.csv"
    command_seconds(HERE, ["simulate", "urp_gb2", "-o", "{data}", "--trajectories", "40", "--seed", "1"], data, folder)
    for i, (title, arguments) in enumerate(COMMANDS.items()):
        if re.search(options.only, title):
            say(title)
            one, other_one = (partial(command_seconds, tree, arguments, data, folder) for tree in (HERE, other))
            found[title] = pairs(one, other_one, options.rounds if i < SHORT else options.processes)
    return found


def main() -> None:
    """Measures, and writes against.md and against.json."""
    made = parser(__doc__)
    made.add_argument("other", type=Path, help="the checkout to compare with")
    made.add_argument("--rounds", type=int, default=9, help="pairs of short commands, and of functions in each start")
    made.add_argument("--starts", type=int, default=7, help="how often the processes of functions are started")
    made.add_argument("--processes", type=int, default=3, help="pairs of fits")
    made.add_argument("--only", default="", help="a regular expression for the names of the work")
    options = made.parse_args()
    other = options.other.resolve()
    with tempfile.TemporaryDirectory() as folder:
        found = functions(other, options) | commands(other, options, Path(folder))
    header = ["processor time", "other", "this", "ratio", "95 %", "pairs"]
    text = markdown(header, [row(name, timings) for name, timings in found.items()])
    write("against", "This checkout and another one", text, {"seconds": found}, options.output)


if __name__ == "__main__":
    main()
