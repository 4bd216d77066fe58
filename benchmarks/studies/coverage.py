"""How often 90 % intervals of learned constants, and 90 % bands of learned functions, contain the truth.

    python -m benchmarks.studies.coverage -o coverage --sets 50 --workers 2
    python -m benchmarks.studies.coverage -o coverage --table docs/studies/coverage.md

Each set is simulated from the model's truth (the sampling of its case, `--trajectories` of it, noise relative to each
channel's standard deviation) with its own seed, and fitted with all defaults, one member. Functions are compared at up
to 200 arguments of the rows that the fit was trained on: a row counts the share of them where the band contains the
truth. Rows are added to OUT/sets.csv as soon as their set is done; the same command run again continues.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .sets import Key, Row, Study, by_model

if TYPE_CHECKING:
    from gbspec.runs import Run

FIELDS = ("model", "noise", "seed", "kind", "name", "truth", "value", "sd", "low", "high", "inside", "seconds")
MODELS = ("urp_gb2", "lotka_volterra", "friction_oscillator", "fed_batch", "one_compartment")
NOISES = (0.02, 0.05)
POINTS = 200
TRAJECTORIES = 12


def one_set(name: str, noise: float, seed: int) -> list[Row]:
    """Simulates and fits one set: a row for each constant and function, with an empty interval if the fit gave none."""
    from gbspec import frontend
    from gbspec.data.cases import find_cases
    from gbspec.diagnostics import Findings
    from gbspec.operations import fitting, models, tables
    from gbspec.training import TrainOptions

    model = frontend.load_model(name, Findings())
    sampling = find_cases(frontend.resolve(name)).of_model(model.name).sampling
    drawn = dataclasses.replace(sampling, trajectories=TRAJECTORIES, noise=noise, seed=seed)
    data = tables.simulate(models.reference(model), drawn)
    began = time.process_time()

    def row(*entries: str | float) -> Row:
        return dict(zip(FIELDS, (name, noise, seed, *entries, round(time.process_time() - began)), strict=True))

    with tempfile.TemporaryDirectory() as place:
        run = fitting.fit(model, data, Path(place) / "run", TrainOptions(threads=1, seed=seed))
        truths = {k.name: k.value for k in models.reference(model).model.constants}
        rows = [row("function", *entries) for entries in functions(run, seed)]
        for constant, found in run.fit.constants.items():
            low, high = found.interval or (math.nan, math.nan)
            truth = truths[constant]
            inside = float(low <= truth <= high) if found.interval else math.nan
            rows.append(row("constant", constant, truth, found.value, found.sd or math.nan, low, high, inside))
    return rows


def functions(run: Run, seed: int) -> Iterable[tuple[str | float, ...]]:
    """For each function its name, rms truth, rms error, mean sd, and the share of points whose band has the truth."""
    from gbspec.analysis.systems import fences, function_bands
    from gbspec.report.unknowns import truth_of

    for unknown in run.model.unknowns:
        truth = truth_of(run.model, unknown.name)
        fence = fences(run).get(run.model.networks[unknown.network].name)
        if truth is None or fence is None:
            continue
        count = min(POINTS, len(fence.points))
        points = np.random.default_rng([seed, 3]).choice(fence.points, count, replace=False)
        mean, low, high = function_bands(run, unknown.name, points)
        true = truth(points)
        error, width = np.sqrt(np.mean((mean - true) ** 2)), np.mean(high - low) / (2 * 1.645)
        inside = float(np.mean((low <= true) & (true <= high))) if np.isfinite(low).all() else math.nan
        yield unknown.name, float(np.sqrt(np.mean(true**2))), float(error), float(width), math.nan, math.nan, inside


def table(rows: Sequence[Row]) -> str:
    """The summary in Markdown: a line for each model, noise and quantity, and pooled lines."""
    lines = [
        f"{TRAJECTORIES} trajectories a set, defaults, one member. `with`: sets with an interval or band; "
        "`error / sd`: for a constant the standard deviation of (value - truth) divided by the mean `sd`, for a "
        "function the rms error divided by the mean sd of its band.",
        "",
        "| model | noise | quantity | sets | with | truth inside | error / sd | CPU s a set |",
        "|---|---:|---|---:|---:|---:|---:|---:|",
    ]
    cells = dict.fromkeys((str(row["model"]), float(row["noise"]), str(row["kind"]), str(row["name"])) for row in rows)
    for cell in cells:
        own = [row for row in rows if cell == (row["model"], float(row["noise"]), row["kind"], row["name"])]
        known = [row for row in own if math.isfinite(float(row["inside"]))]
        seconds = np.mean([float(row["seconds"]) for row in own])
        lines.append(f"| {cell[0]} | {100 * cell[1]:g} % | {cell[3]} | {len(own)} | {len(known)} | {_share(known)} | "
                     f"{_ratio(known):.2f} | {seconds:.0f} |")  # fmt: skip
    for kind in ("constant", "function"):
        known = [row for row in rows if row["kind"] == kind and math.isfinite(float(row["inside"]))]
        lines.append(f"| all | | {kind}s | | {len(known)} | {_share(known)} | | |")
    return "\n".join(lines) + "\n"


def _share(rows: Sequence[Row]) -> str:
    return f"{100 * np.mean([float(row['inside']) for row in rows]):.0f} %" if rows else "-"


def _ratio(rows: Sequence[Row]) -> float:
    """Errors in standard deviations."""
    if not rows:
        return math.nan
    width = float(np.mean([float(row["sd"]) for row in rows]))
    if rows[0]["kind"] == "function":
        return float(np.sqrt(np.mean([float(row["value"]) ** 2 for row in rows]))) / width
    return float(np.std([float(row["value"]) - float(row["truth"]) for row in rows])) / width


def _wanted(chosen: argparse.Namespace) -> Iterable[Key]:
    return [(name, noise, seed) for seed in range(chosen.sets) for name in chosen.models for noise in NOISES]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sets", type=int, default=50)
    parser.add_argument("--models", nargs="*", default=list(MODELS))


STUDY = Study("coverage", __doc__, FIELDS, one_set, by_model, _wanted, table, _options)

if __name__ == "__main__":
    STUDY.run()
