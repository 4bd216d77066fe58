"""How often the 90 % intervals of learned constants contain the truth, on simulated data sets.

    python -m benchmarks.studies.coverage -o coverage --sets 100 --workers 2
    python -m benchmarks.studies.coverage -o coverage --table docs/studies/coverage.md

Each set is simulated from the model's truth (the sampling of its case, `--trajectories` of it, `--noise` relative to
each channel's standard deviation) with its own seed, and fitted with all defaults, one member. A row is added to
OUT/sets.csv as soon as its set is done; the same command run again continues with the missing sets.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import os
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

FIELDS = ("set", "constant", "truth", "value", "sd", "low", "high", "inside", "seconds")
Row = dict[str, str | float | int]


@dataclasses.dataclass(frozen=True)
class Design:
    """The settings common to all sets."""

    model: str
    trajectories: int
    noise: float


def one_set(design: Design, seed: int) -> list[Row]:
    """Simulates and fits one set: a row for each constant, with an empty interval if the fit gave none."""
    from gbspec import frontend
    from gbspec.data.cases import find_cases
    from gbspec.diagnostics import Findings
    from gbspec.operations import fitting, models, tables
    from gbspec.training import TrainOptions

    model = frontend.load_model(design.model, Findings())
    sampling = find_cases(frontend.resolve(design.model)).of_model(model.name).sampling
    drawn = dataclasses.replace(sampling, trajectories=design.trajectories, noise=design.noise, seed=seed)
    data = tables.simulate(models.reference(model), drawn)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as place:
        fit = fitting.train(model, data, Path(place) / "run", TrainOptions(threads=1, workers=1)).fit
    seconds = time.process_time() - began
    truths = {k.name: k.value for k in models.reference(model).model.constants}
    rows: list[Row] = []
    for name, found in fit.constants.items():
        low, high = found.interval or (math.nan, math.nan)
        rows.append(
            dict(zip(FIELDS, (seed, name, truths[name], found.value, found.sd or math.nan, low, high,
                              int(low <= truths[name] <= high), round(seconds)), strict=True))
        )  # fmt: skip
    return rows


def table(rows: Sequence[Row], design: Design) -> str:
    """The summary in Markdown: for each constant the numbers of sets, of intervals, and of those with the truth."""
    lines = [
        f"`{design.model}`, {design.trajectories} trajectories a set, {100 * design.noise:g} % noise, defaults, one "
        'member. "error / sd": standard deviation of (value - truth) divided by the mean `sd`.',
        "",
        "| constant | sets | with interval | truth inside | share | mean error | error / sd | CPU s a set |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(str(row["constant"]) for row in rows):
        own = [row for row in rows if row["constant"] == name]
        known = [row for row in own if math.isfinite(float(row["sd"]))]
        inside = sum(int(row["inside"]) for row in known)
        errors = [float(row["value"]) - float(row["truth"]) for row in own]
        mean = sum(errors) / len(errors)
        sd = math.sqrt(sum((e - mean) ** 2 for e in errors) / max(len(errors) - 1, 1))
        width = sum(float(row["sd"]) for row in known) / max(len(known), 1)
        seconds = sum(float(row["seconds"]) for row in own) / len(own)
        lines.append(
            f"| {name} | {len(own)} | {len(known)} | {inside} | {100 * inside / max(len(known), 1):.0f} % | "
            f"{mean:+.2g} | {sd / width if width else math.nan:.2f} | {seconds:.0f} |"
        )
    return "\n".join(lines) + "\n"


def read(path: Path) -> list[Row]:
    """The rows of the finished sets."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [dict(row) for row in csv.DictReader(file)]


def append(path: Path, rows: Sequence[Row]) -> None:
    """Appends the rows of a set in one write."""
    new = not path.is_file()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if new:
            writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies.coverage", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("coverage"))
    parser.add_argument("--model", default="urp_gb2")
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--trajectories", type=int, default=25)
    parser.add_argument("--noise", type=float, default=0.02)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", type=Path, help="write the table of the finished sets, without fitting")
    chosen = parser.parse_args()
    design = Design(chosen.model, chosen.trajectories, chosen.noise)
    sets = chosen.output / "sets.csv"
    if chosen.table is None:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        chosen.output.mkdir(parents=True, exist_ok=True)
        done = {int(row["set"]) for row in read(sets)}
        with ProcessPoolExecutor(chosen.workers, mp_context=get_context("spawn")) as pool:
            pending = [pool.submit(one_set, design, seed) for seed in range(chosen.sets) if seed not in done]
            for future in as_completed(pending):
                append(sets, future.result())
    rows = read(sets)
    if not rows:
        raise SystemExit(f"{sets}: no finished sets yet")
    text = table(rows, design)
    print(text)
    if chosen.table is not None:
        chosen.table.write_text(text)


if __name__ == "__main__":
    main()
