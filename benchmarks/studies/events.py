"""Models with events: constants found from simulated data, without noise and with 2 % noise, against the truth.

    python -m benchmarks.studies.events -o events.md

The bundled models with the data of `models/switching/cases.toml`, all defaults, one member. Each fit is a process of
its own, whose processor time includes the imports and the compilation of the kernel (a fresh cache each time).

    python -m benchmarks.studies.events --stiff -o stiff_events.md

The stiff models of `switching/`, and the bouncing ball with adaptive steps, without noise.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import gbspec

MODELS = ("bouncing_ball", "thermostat", "overflowing_tanks")
CASES = Path(gbspec.__file__).parents[1] / "models" / "switching" / "cases.toml"
HEAD = (
    "| model | values | noise | seed | constant | found | truth | sd of the fit | error | CPU s | backend | solver |",
    "|---|---:|---:|---:|---|---:|---:|---:|---:|---:|---|---|",
)
FOLDER = Path(__file__).parent / "switching"
STIFF = (
    (str(FOLDER / "fast_sensor.gb"), {"span": 12, "dt": 0.3}, ()),
    (str(FOLDER / "fed_robertson.gb"), {"span": 200, "dt": 4}, ()),
    (str(FOLDER / "pushed_oscillator.gb"), {"span": 2000, "dt": 40}, ()),
    ("bouncing_ball", {"span": 5, "dt": 0.1}, ("--tolerance", "1e-6")),
    ("bouncing_ball", {"span": 5, "dt": 0.1}, ("--solver", "ros34pw2")),
)
"""Models, how their data are simulated, and options of the fit."""


@dataclass(frozen=True)
class Fit:
    """A finished fit: `record` is its fit.json, `said` what the command printed, `seconds` of processor time."""

    model: str
    noise: float
    seed: int
    record: dict[str, object]
    said: str
    seconds: float
    values: int


def fit_of(model: str, noise: float, seed: int, sampling: Sequence[str], *options: str) -> Fit:
    """Simulates data and fits the model to them."""
    with tempfile.TemporaryDirectory() as folder:
        data, run = Path(folder) / "data.csv", Path(folder) / "run"
        _command(folder, "simulate", model, "-o", str(data), "--seed", str(seed), *_noise(noise), *sampling)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        said = _command(folder, "train", model, str(data), "-o", str(run), *options)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        record = json.loads((run / "fit.json").read_text(encoding="utf-8"))
        return Fit(model, noise, seed, record, said, seconds, _values(model, data))


def _values(model: str, data: Path) -> int:
    """The number of measured values in a table."""
    channels = [channel.name for channel in gbspec.load(model).model.channels]
    with data.open(encoding="utf-8", newline="") as lines:
        return sum(bool(row[name]) for row in csv.DictReader(lines) for name in channels)


def _noise(noise: float) -> list[str]:
    return ["--noise", f"{noise:g}"] if noise else []


def _sampling(model: str) -> list[str]:
    """The options of `simulate` for a case of the bundled models."""
    cases = tomllib.loads(CASES.read_text(encoding="utf-8"))
    return _options(cases["sampling"] | cases["case"][model].get("sampling", {}))


def _options(sampling: Mapping[str, object]) -> list[str]:
    return [word for name, value in sampling.items() for word in (f"--{name}", str(value))]


def _command(folder: str, *words: str) -> str:
    """Runs a command of gbspec with kernels of its own; returns what it printed."""
    given = os.environ | {"GBSPEC_CACHE": f"{folder}/kernels", "OMP_NUM_THREADS": "1"}
    call = [sys.executable, "-m", "gbspec", *words]
    done = subprocess.run(call, env=given, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)}: {done.stderr}")
    return done.stdout + done.stderr


def rows_of(fit: Fit) -> Iterator[str]:
    """A line for each constant, with its error in standard deviations of the fit where the data are noisy."""
    model = gbspec.load(fit.model).model
    truth = {item.name: item.value for item in model.truth_constants}
    constants = fit.record["constants"]
    backend = "graph" if "the torch graph is used" in fit.said else "kernel"
    assert isinstance(constants, dict)
    for i, (name, found) in enumerate(constants.items()):
        error, sd = found["value"] - truth[name], found["sd"]
        off = f"{error / sd:+.2f} sd" if fit.noise and sd else f"{abs(error / truth[name]):.1e}"
        first = (model.name, str(fit.values), f"{100 * fit.noise:g} %", str(fit.seed)) if not i else ("",) * 4
        last = (f"{fit.seconds:.0f}", backend, str(fit.record["solver"])) if not i else ("",) * 3
        said = "-" if sd is None else f"{sd:.2g}"
        cells = (*first, name, f"{found['value']:.9g}", f"{truth[name]:g}", said, off, *last)
        yield f"| {' | '.join(cells)} |"


def remarks_of(fit: Fit) -> Iterator[str]:
    """How the search went, and the warnings."""
    members = fit.record["members"]
    assert isinstance(members, list)
    named = f"- {Path(fit.model).stem}, {fit.record['solver']}, noise {100 * fit.noise:g} %, seed {fit.seed}"
    for stage in members[0]["stages"]:
        if stage.get("remark"):
            yield f"{named}: {stage['remark']}; loss {members[0]['loss']:.3g}"
    warnings = fit.record["warnings"]
    assert isinstance(warnings, list)
    yield from (f"{named}: {text}" for text in warnings)


def main() -> None:
    """Writes the table, and what the fits said, as each is done."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--models", nargs="*", default=MODELS)
    parser.add_argument("--noise", type=float, nargs="*", default=[0.0, 0.02])
    parser.add_argument(
        "--seeds", type=int, nargs="*", default=[1, 2, 3], help="of noisy data; the first of exact ones"
    )
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--stiff", action="store_true", help="the stiff models and adaptive steps instead")
    given = parser.parse_args()
    lines, remarks = list(HEAD), [""]
    for fit in _stiff_fits() if given.stiff else _fits(given):
        lines += rows_of(fit)
        remarks += remarks_of(fit)
        given.output.write_text("\n".join([*lines, *remarks]) + "\n", encoding="utf-8")


def _fits(given: argparse.Namespace) -> Iterator[Fit]:
    for noise in given.noise:
        for model in given.models:
            for seed in given.seeds if noise else given.seeds[:1]:
                yield fit_of(model, noise, seed, _sampling(model), "--backend", given.backend)


def _stiff_fits() -> Iterator[Fit]:
    for model, sampling, options in STIFF:
        times = _options({"trajectories": 1, "sampling": "regular", **sampling})
        yield fit_of(model, 0.0, 1, times, *options)


if __name__ == "__main__":
    main()
