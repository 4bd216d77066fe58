"""The cost of an ensemble compared with one member, and the start-up time of its workers.

    python -m benchmarks.ensemble [--members 10] [--trajectories 40] [--effort low] [--workers 1 2]

Each run is a `gbspec train` process with the defaults of the command: one member uses all cores for its large matrices,
members of an ensemble share them. On a busy machine, processor time is more reliable than wall time: `by processor
time` is the processor time of the ensemble divided by the number of workers, relative to that of one member; on an idle
machine it is the ratio of wall times.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.harness import BUSY, clock, cores, markdown, parser, process, say, write

MODEL = "urp_gb2"


def measure(options: argparse.Namespace, folder: Path) -> dict[str, dict[str, float]]:
    """Wall and processor seconds of one member, and of ensembles by number of workers."""
    table = folder / "data.csv"
    simulated = ["--trajectories", str(options.trajectories), "--sampling", "gamma", "--channels", "own-clock"]
    process("-m", "gbspec", "simulate", MODEL, "-o", str(table), *simulated, "--seed", "1")()
    out = {}
    runs = {"one member": ["--members", "1"]}
    for workers in options.workers:
        title = f"{options.members} members, {workers} worker{'s' if workers > 1 else ''}"
        runs[title] = ["--members", str(options.members), "--workers", str(workers)]
    for title, more in runs.items():
        say(title)
        to = ["-o", str(folder / title.replace(" ", "_")), "--effort", options.effort, "--quiet"]
        wall, cpu = clock(process("-m", "gbspec", "train", MODEL, str(table), *to, *more))
        workers = int(more[-1]) if len(more) > 2 else 1
        out[title] = {"wall": round(wall, 2), "cpu": round(cpu, 2), "workers": workers}
    return out


def rows(found: Mapping[str, Mapping[str, float]]) -> str:
    """Wall and processor time, and both relative to one member's."""
    one = found["one member"]
    lines = [
        [
            title,
            f"{each['wall']:.1f} s",
            f"{each['cpu']:.1f} s",
            f"{each['wall'] / one['wall']:.2f}",
            f"{each['cpu'] / each['workers'] / one['cpu']:.2f}",
        ]
        for title, each in found.items()
    ]
    text = markdown(["", "wall time", "processor time", "x one member", "by processor time"], lines)
    share = one["cpu"] / one["wall"]
    if share < BUSY:
        text += f"\n\nThe machine was busy: one member got {share:.0%} of a core. Only the last column tells something."
    return text


def main() -> None:
    """Runs the benchmark and writes ensemble.md and ensemble.json."""
    made = parser(__doc__)
    made.add_argument("--members", type=int, default=10)
    made.add_argument("--trajectories", type=int, default=40)
    made.add_argument("--effort", default="low")
    made.add_argument("--workers", type=int, nargs="+", default=[len(cores())])
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found: dict[str, Any] = measure(options, Path(folder))
    write("ensemble", "The cost of an ensemble", rows(found), {"runs": found}, options.output)


if __name__ == "__main__":
    main()
