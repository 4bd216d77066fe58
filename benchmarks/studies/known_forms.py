"""How often the search for constants of known forms finds the best minimum, with bounds over six decades.

    python -m benchmarks.studies.known_forms -o known_forms --seeds 5 --workers 2
    python -m benchmarks.studies.known_forms -o known_forms --table docs/studies/known_forms.md

Each model of `known_forms.toml` is simulated from its true constants with 2 % noise relative to each channel's standard
deviation, a set for each seed. Every constant has bounds that are six decades apart and contain the truth at a random
place in their four inner decades; the starting value is the default one. Each set is fitted with all defaults, and once
more from the truth itself, by least squares alone, at the step that the first fit ended with. The best minimum is found
if the loss of the first fit is at most that of the second, up to a part in a thousand. A row is added to OUT/sets.csv
as soon as its set is done; the same command run again continues.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .sets import Key, Row, Study

FIELDS = ("model", "seed", "constants", "loss", "reference", "found", "starts", "error", "seconds")
DECADES, INNER = 6.0, 4.0
"""Decades between the bounds, and the inner ones in which the truth lies."""
NOISE = 0.02
SAME, ROUNDING = 1e-3, 1e-12
"""Differences of losses, relative and absolute, that do not count."""


@dataclass(frozen=True)
class Form:
    """A model of the study: states with a range of initial values or an exact one, true constants, balances."""

    name: str
    states: Mapping[str, float | list[float]]
    constants: Mapping[str, float]
    balances: Sequence[str]
    span: float
    dt: float
    observed: Sequence[str] = ()
    trajectories: int = 2

    def text(self, learned: Mapping[str, str]) -> str:
        """The model, with a declaration for each constant."""
        lines = [f"model {self.name}", "time t from 0"]
        for name, start in self.states.items():
            bounds = f" in [{start[0]}, {start[1]}]" if isinstance(start, list) else ""
            lines += [f"state {name}{bounds}"] + ([] if bounds else [f"initial {name} = {start}"])
        lines += [f"learn {name} {learned[name]}" for name in self.constants]
        lines += [*self.balances, *(f"observe {channel}" for channel in self.observed or self.states)]
        return "\n".join([*lines, *(f"truth {name} = {value!r}" for name, value in self.constants.items())]) + "\n"

    def within(self, seed: int) -> dict[str, str]:
        """Bounds around the truth."""
        rng = np.random.default_rng([seed, len(self.constants)])
        below = rng.uniform((DECADES - INNER) / 2, (DECADES + INNER) / 2, len(self.constants))
        ends = {k: v * 10.0**-d for (k, v), d in zip(self.constants.items(), below, strict=True)}
        return {name: f"in [{low:.6g}, {low * 10**DECADES:.6g}]" for name, low in ends.items()}


def forms() -> dict[str, Form]:
    """The models of the study by name."""
    content = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    return {name: Form(name, **entry) for name, entry in content.items()}


def one_set(name: str, seed: int) -> list[Row]:
    """Simulates a set and fits it twice."""
    from gbspec import frontend
    from gbspec.data import SimulateOptions
    from gbspec.diagnostics import ComputationError, Findings
    from gbspec.operations import fitting, models, tables
    from gbspec.training import TrainOptions

    form = forms()[name]
    with tempfile.TemporaryDirectory() as place:
        path, bounds = Path(place) / f"{form.name}.gb", form.within(seed)
        path.write_text(form.text(bounds), encoding="utf-8")
        model = frontend.load_model(str(path), Findings())
        drawn = SimulateOptions(form.trajectories, form.span, form.dt, keep_start=True, noise=NOISE, seed=seed)
        data = tables.simulate(models.reference(model), drawn)
        path.write_text(form.text({k: f"{bounds[k]} = {v!r}" for k, v in form.constants.items()}), encoding="utf-8")
        there = frontend.load_model(str(path), Findings())
        began = time.process_time()
        try:
            run = fitting.fit(model, data, Path(place) / "run", TrainOptions(threads=1, seed=seed))
        except ComputationError as failure:
            print(f"{form.name} {seed}: {failure.what}", flush=True)
            run = None
        seconds = time.process_time() - began
        # At the step that the fit ended with: a coarser one moves the least loss by its own error.
        least = TrainOptions(
            threads=1,
            stages="least squares; least squares, starts too",
            warm_start=False,
            max_step=None if run is None else run.step(0),
        )
        reference = fitting.fit(there, data, Path(place) / "reference", least).fit.members[0]
        if run is None:
            return [dict(zip(FIELDS, (form.name, seed, len(form.constants), math.nan, reference.loss or math.nan, 0, "",
                                      math.nan, 0), strict=True))]  # fmt: skip
        fit = run.fit
    loss, best = fit.members[0].loss or 0.0, reference.loss or 0.0
    search = next(stage.remark for stage in fit.members[0].stages if stage.name == "search") or ""
    error = max(abs(math.log10(fit.constants[k].value / v)) for k, v in form.constants.items())
    found = int(loss <= best * (1 + SAME) + ROUNDING)
    return [dict(zip(FIELDS, (form.name, seed, len(form.constants), loss, best, found, search, error,
                              round(seconds, 1)), strict=True))]  # fmt: skip


def table(rows: Sequence[Row]) -> str:
    """The summary in Markdown: a line for each model, and all sets."""
    lines = [
        f"Bounds over six decades, {100 * NOISE:g} % noise, defaults, one member; `found`: loss at most that of a fit "
        "from the truth.",
        "",
        "| model | constants | sets | found | largest loss / reference | CPU s a set |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for name in dict.fromkeys(str(row["model"]) for row in rows):
        own = [row for row in rows if row["model"] == name]
        ratio = max(float(row["loss"]) / max(float(row["reference"]), 1e-300) for row in own)
        seconds = sum(float(row["seconds"]) for row in own) / len(own)
        found = sum(int(row["found"]) for row in own)
        lines.append(f"| {name} | {own[0]['constants']} | {len(own)} | {found} | {ratio:.4g} | {seconds:.0f} |")
    found = sum(int(row["found"]) for row in rows)
    lines.append(f"| all | | {len(rows)} | {found} ({100 * found / len(rows):.0f} %) | | |")
    return "\n".join(lines) + "\n"


def _wanted(chosen: argparse.Namespace) -> Iterable[Key]:
    return [(name, seed) for seed in range(chosen.seeds) for name in chosen.models or forms()]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--models", nargs="*", help="some of the models")
    parser.add_argument("--seeds", type=int, default=5)


def _key(row: Row) -> Key:
    return str(row["model"]), int(row["seed"])


STUDY = Study("known_forms", __doc__, FIELDS, one_set, _key, _wanted, table, _options)

if __name__ == "__main__":
    STUDY.run()
