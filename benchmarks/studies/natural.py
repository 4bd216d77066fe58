"""Few rows, states that nobody measures, unknown functions of them: models as a newcomer would write them.

    python -m benchmarks.studies.natural -o natural --seeds 3 --workers 2
    python -m benchmarks.studies.natural -o natural --table docs/studies/natural.md

Each model of `natural/` is simulated from its truth, without noise and with 2 % of each channel's standard deviation,
and fitted with all defaults. `r2`: R² of whole solutions in the worst channel; `naive`: the same of the best predictor
that knows no model; `loss_noise`: loss over that of the noise alone (with noise); `error`: the largest relative error
of a constant, `inside`: how many of the constants' 90 % intervals contain the truth, of `known`. A row is added to
OUT/sets.csv as soon as its fit is done; the same command run again continues with the missing fits.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from .sets import Key, Row, Study, by_model

FIELDS = ("model", "noise", "seed", "r2", "naive", "loss_noise", "error", "inside", "known", "seconds")
NOISES = (0.0, 0.02)


@dataclass(frozen=True)
class Sampling:
    """How much is measured: trajectories, duration and mean interval of their rows."""

    trajectories: int
    span: float
    interval: float
    sampling: Literal["regular", "gamma"] = "gamma"


MODELS = {
    "compartments": Sampling(6, 24, 1, "regular"),
    "culture": Sampling(6, 10, 0.5),
    "enzyme": Sampling(6, 10, 0.5),
    "epidemic": Sampling(4, 80, 2),
    "fed_culture": Sampling(8, 12, 0.5),
    "house": Sampling(1, 240, 0.5, "regular"),
    "pendulum": Sampling(4, 8, 0.1),
}


def one_fit(name: str, noise: float, seed: int) -> list[Row]:
    """Simulates a set and fits it."""
    from gbspec import frontend
    from gbspec.data import SimulateOptions
    from gbspec.diagnostics import Findings
    from gbspec.operations import fitting, models, tables
    from gbspec.training import TrainOptions

    chosen = MODELS[name]
    model = frontend.load_model(Path(__file__).with_name("natural") / f"{name}.gb", Findings())
    drawn = SimulateOptions(
        chosen.trajectories, chosen.span, chosen.interval, sampling=chosen.sampling, noise=noise, seed=seed
    )
    data = tables.simulate(models.reference(model), drawn)
    truths = {constant.name: constant.value for constant in models.reference(model).model.constants}
    began = time.process_time()
    with tempfile.TemporaryDirectory() as place:
        fit = fitting.fit(model, data, Path(place) / "run", TrainOptions(threads=1, seed=seed)).fit
    seconds = time.process_time() - began
    (member,) = fit.members
    channels = (member.channels or {}).values()
    own, naive = (min(value for value in values if value is not None)
                  for values in ([c.r2 for c in channels], [c.naive for c in channels]))  # fmt: skip
    share = (member.loss or 0.0) / (0.5 * noise**2) if noise else 0.0
    errors = [abs(found.value / truths[name] - 1) for name, found in fit.constants.items()]
    inside = [
        found.interval[0] <= truths[name] <= found.interval[1]
        for name, found in fit.constants.items()
        if found.interval is not None
    ]
    values = (name, noise, seed, own, naive, share, max(errors, default=0.0), sum(inside), len(inside), round(seconds))
    return [dict(zip(FIELDS, values, strict=True))]


def table(rows: Sequence[Row]) -> str:
    """The table in Markdown: a line for each model and noise, with the worst of its fits."""
    lines = [
        "Defaults, one member; the worst of the fits. `inside`: intervals of constants that contain the truth. "
        "A constant whose interval covers its bounds counts too; the fit says that it is not determined (the yield of "
        "`fed_culture` in two sets of the three with noise).",
        "",
        "| model | noise | fits | R² | naive R² | loss / noise | error of constants | inside | CPU s a fit |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, noise in dict.fromkeys((str(row["model"]), float(row["noise"])) for row in rows):
        own = [row for row in rows if (row["model"], float(row["noise"])) == (name, noise)]
        naive, share, error = (max(float(row[key]) for row in own) for key in ("naive", "loss_noise", "error"))
        inside, known, seconds = (sum(float(row[key]) for row in own) for key in ("inside", "known", "seconds"))
        shown = f"{share:.3g}" if noise else "-"
        lines.append(f"| {name} | {100 * noise:g} % | {len(own)} | {min(float(row['r2']) for row in own):.6f} | "
                     f"{naive:.3f} | {shown} | {error:.2g} | {inside:.0f} of {known:.0f} | "
                     f"{seconds / len(own):.0f} |")  # fmt: skip
    return "\n".join(lines) + "\n"


def _wanted(chosen: argparse.Namespace) -> Iterable[Key]:
    return [(name, noise, seed) for seed in range(chosen.seeds) for noise in NOISES for name in MODELS]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=int, default=3)


STUDY = Study("natural", __doc__, FIELDS, one_fit, by_model, _wanted, table, _options)

if __name__ == "__main__":
    STUDY.run()
