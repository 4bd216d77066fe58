"""How often 90 % bands of splines contain the true function, by their number of coefficients.

    python -m benchmarks.studies.splines -o splines
    python -m benchmarks.studies.splines -o splines --table docs/studies/splines.md

Bundled models whose unknown has one argument, with `by spline(n)` in place of the network, are simulated and fitted as
in `benchmarks.studies.coverage`, whose functions compare their bands with the truth. Each row notes whether the fit
said that the spline is too coarse.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from .coverage import NOISES, TRAJECTORIES, functions
from .sets import Key, Row, Study

FIELDS = ("model", "size", "noise", "seed", "name", "scale", "error", "sd", "inside", "told", "seconds")
MODELS = ("one_compartment", "fed_batch", "friction_oscillator")
SIZES = (8, 12, 20, 40)
TOLD = "is too coarse"


def one_set(name: str, size: int, noise: float, seed: int) -> list[Row]:
    """Simulates and fits one set with splines of `size` coefficients: a row for each function."""
    from gbspec import frontend
    from gbspec.data.cases import find_cases
    from gbspec.diagnostics import Findings, Source
    from gbspec.operations import fitting, models, tables
    from gbspec.training import TrainOptions

    path = frontend.resolve(name)
    text = re.sub(r"by mlp\([^)]*\)", f"by spline({size})", Path(path).read_text(encoding="utf-8"))
    model = frontend.load_model(str(path), Findings(), lambda read: Source(str(read), text))
    sampling = find_cases(path).of_model(model.name).sampling
    drawn = dataclasses.replace(sampling, trajectories=TRAJECTORIES, noise=noise, seed=seed)
    data = tables.simulate(models.reference(model), drawn)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as place:
        run = fitting.fit(model, data, Path(place) / "run", TrainOptions(threads=1, seed=seed))
        told = float(any(TOLD in warning for warning in run.fit.warnings))
        seconds = round(time.process_time() - began)
        return [
            dict(zip(FIELDS, (name, size, noise, seed, unknown, scale, error, sd, inside, told, seconds), strict=True))
            for unknown, scale, error, sd, _, _, inside in functions(run, seed)
        ]


def by_set(row: Row) -> Key:
    """The key of a row."""
    return str(row["model"]), int(row["size"]), float(row["noise"]), int(row["seed"])


def table(rows: Sequence[Row]) -> str:
    """The summary in Markdown: a line for each model, noise and number of coefficients, and pooled lines."""
    lines = [
        f"{TRAJECTORIES} trajectories a set, defaults, one member. Truth inside: the share of up to 200 arguments "
        "of the fitted rows at which the 90 % band contains the true function; error and mean sd of the band as shares "
        "of the function's root mean square; told: fits that said that the spline is too coarse.",
        "",
        "| model | noise | coefficients | sets | truth inside | error | sd | told | CPU s a set |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    cells = sorted({(str(row["model"]), float(row["noise"]), int(row["size"])) for row in rows}, key=_order)
    for model, noise, size in cells:
        own = [r for r in rows if (r["model"], float(r["noise"]), int(r["size"])) == (model, noise, size)]
        lines.append(f"| {model} | {100 * noise:g} % | {size} | {_cells(own)} | {_mean(own, 'seconds'):.0f} |")
    for told, label in ((0.0, "not told"), (1.0, "told")):
        own = [row for row in rows if float(row["told"]) == told]
        if own:
            lines.append(f"| all, {label} | | | {_cells(own)} | |")
    return "\n".join(lines) + "\n"


def _order(cell: tuple[str, float, int]) -> tuple[int, float, int]:
    return MODELS.index(cell[0]), cell[1], cell[2]


def _cells(rows: Sequence[Row]) -> str:
    known = [row for row in rows if math.isfinite(float(row["inside"]))]
    error, sd = (
        float(np.sqrt(np.mean([(float(row[of]) / float(row["scale"])) ** 2 for row in known])))
        for of in ("error", "sd")
    )
    told = sum(float(row["told"]) for row in rows)
    return f"{len(rows)} | {100 * _mean(known, 'inside'):.0f} % | {100 * error:.2g} % | {100 * sd:.2g} % | {told:.0f}"


def _mean(rows: Sequence[Row], name: str) -> float:
    return float(np.mean([float(row[name]) for row in rows]))


def _wanted(chosen: argparse.Namespace) -> Iterable[Key]:
    return [
        (name, size, noise, seed)
        for seed in range(chosen.sets)
        for name in chosen.models
        for noise in NOISES
        for size in chosen.sizes
    ]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sets", type=int, default=4)
    parser.add_argument("--models", nargs="*", default=list(MODELS))
    parser.add_argument("--sizes", nargs="*", type=int, default=list(SIZES))


STUDY = Study("splines", __doc__, FIELDS, one_set, by_set, _wanted, table, _options)

if __name__ == "__main__":
    STUDY.run()
