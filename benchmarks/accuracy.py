"""Processor time to a given accuracy: `gbspec train` compared with hand-written fits with torchdiffeq and diffrax.

    python -m benchmarks.accuracy [--seconds 110] [--fits gbspec torchdiffeq diffrax diffrax-ar] [--trajectories 100]

All fit `urp_gb2` with a network 3-64-64-1 to the same simulated data: each channel has its own irregular times, initial
states are unknown. gbspec runs as the command does, with its defaults (Runge-Kutta steps of 0.1, as for the others).
The others are typical hand-written code: inputs scaled by the data, initial states guessed from the first measurements
and learned, B and beta learned as logarithms, Adam with a one-cycle schedule that ends with the time budget. The error
is that of the learned right-hand side on solutions of the truth that no fit has seen (norm L2 of the paper's appendix).
Times are processor times, including compilation, excluding reading data and importing libraries.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gbspec
from benchmarks.harness import markdown, parser, pinned, processor_seconds, say, write
from benchmarks.variants import prepare_jax
from benchmarks.workload import MAX_STEP, REGION, Array, Size, Workload, of_data
from gbspec.analysis.validation.metrics import norms
from gbspec.data.trajectories import Trajectories
from gbspec.training.problem.forcing import measured_states
from gbspec.training.problem.packing import pack

FITS = {
    "gbspec": ("**gbspec train**", "", ""),
    "torchdiffeq": ("torch, torchdiffeq, Adam; teacher forcing", "benchmarks.peers.torchdiffeq_fit", "fit"),
    "diffrax": ("diffrax, optax Adam; teacher forcing", "benchmarks.peers.diffrax_fit", "fit_teacher_forced"),
    "diffrax-ar": ("diffrax, optax Adam; autoregressive", "benchmarks.peers.diffrax_fit", "fit_autoregressive"),
}
"""Title, module and function of each."""

LEVELS = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
SNAPSHOTS = 100
TRUTH = {"B": 11.0, "beta": 3.0}

Layers = Sequence[Array]
"""Weight [out, in] and bias [out] of each layer in turn."""


# ------------------------------------------------------------------------------------------------------ data and error
def data(trajectories: int, span: float = 10.0) -> Trajectories:
    """The data that all fits use."""
    model = gbspec.load("urp_gb2")
    return model.simulate(
        trajectories=trajectories, span=span, sampling="gamma", channels="own-clock", seed=0, **REGION
    )


def points() -> tuple[Array, Array]:
    """States and conditions [P, 3] on solutions that were not trained on, and the true right-hand side [P, 2] there."""
    made = gbspec.load("urp_gb2").simulate(trajectories=50, dt=0.25, keep_start=True, seed=1000, **REGION)
    at = np.concatenate([np.column_stack([i.values, np.full(len(i.times), i.condition[0])]) for i in made.items])
    x1, x2, Da = at.T
    return at, right_hand_side(at, Da * (1 - x1) * np.exp(x2), *TRUTH.values())


def right_hand_side(at: Array, phi: Array, B: float, beta: float) -> Array:
    """The balances of `urp_gb2` at states and conditions [P, 3]."""
    return np.stack([-at[:, 0] + phi, -at[:, 1] + B * phi - beta * at[:, 1]], axis=1)


def network(layers: Layers, scales: Sequence[Array], at: Array) -> Array:
    """The learned function [P] at its arguments [P, 3]."""
    center, scale, output_center, output_scale = scales
    a = (at - center) / scale
    for i, (w, b) in enumerate(zip(layers[::2], layers[1::2], strict=True)):
        if i:
            a = a / (1 + np.exp(-a))
        a = a @ w.T + b
    return np.asarray((output_center + output_scale * a)[:, 0])


# ---------------------------------------------------------------------------------------------------------------- fits
class Record:
    """Snapshots of a fit: processor seconds since it began, layers, constants, scales of the network."""

    def __init__(self) -> None:
        self.began = processor_seconds()
        self.taken: list[tuple[float, Layers, Array, Sequence[Array]]] = []

    def take(self, layers: Layers, constants: Array, scales: Sequence[Array]) -> None:
        """Takes a snapshot."""
        self.taken.append((processor_seconds() - self.began, layers, constants, scales))

    def errors(self) -> list[dict[str, float]]:
        """Their errors against the truth."""
        at, truth = points()
        out = []
        for time, layers, (B, beta), scales in self.taken:
            found = right_hand_side(at, network(layers, scales, at), B, beta)
            error = norms(truth, found, np.ones(2), ["x1", "x2"]).L2
            out.append({"seconds": time, "error": error, "B": float(B), "beta": float(beta)})
        return out


def fit_gbspec(table: Trajectories, **options: Any) -> Record:
    """Fits by `gbspec train`; snapshots are its checkpoints, which are written more often than usual."""
    from gbspec.runs import files
    from gbspec.training.problem.parameters import Parameters
    from gbspec.training.runs import member

    model = gbspec.load("urp_gb2")
    member.SAVE_EVERY = 0.5
    count = len(table)
    prefix = f"network.{model.model.networks[0].name}."

    def take(arrays: Mapping[str, Array]) -> None:
        fixed = {name.removeprefix("fixed."): a for name, a in arrays.items() if name.startswith("fixed.")}
        layout = Parameters(model.model, np.zeros((count, 2)), np.ones(2), np.ones((count, 2)), fixed)
        take_weights(layout.natural(arrays["best"]))

    def take_weights(weights: Mapping[str, Array]) -> None:
        layers = [weights[f"{prefix}{i}.{part}"] for i in range(3) for part in ("weight", "bias")]
        scales = [weights[prefix + s] for s in ("input_center", "input_scale", "output_center", "output_scale")]
        record.take(layers, weights["constants"], scales)

    class Watch:
        seen = 0

        def update(self, update: object) -> None:
            path = next(directory.glob(f"members/*/{files.CHECKPOINT}"), None)
            if path is not None and path.stat().st_mtime_ns != self.seen:
                self.seen = path.stat().st_mtime_ns
                take(files.read_tensors(path)[0])

        def message(self, text: str) -> None:
            pass

    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder) / "run"
        record = Record()
        run = model.train(table, directory, max_step=MAX_STEP, workers=1, threads=1, progress=Watch(), **options)
        take_weights(run.member().weights)
    return record


def fit_by_hand(name: str, table: Trajectories, budget: float) -> Record:
    """Fits by one of the peers, for `budget` processor seconds."""
    _, module, function = FITS[name]
    prepare_jax()
    fit = getattr(importlib.import_module(module), function)
    work = prepared(table)
    scales = (work.input_center, work.input_scale, work.output_center, work.output_scale)
    record = Record()
    every = 1

    def steps(step: Callable[[], None]) -> int:
        nonlocal every
        step()  # compiles
        begun = processor_seconds()
        for _ in range(3):
            step()
        pace = (processor_seconds() - begun) / 3
        total = max(10, int((budget - (processor_seconds() - record.began)) / pace))
        every = max(1, total // SNAPSHOTS)
        say(f"{name}: {total} steps of {1e3 * pace:.0f} ms")
        return total

    taken = 0

    def take(snapshot: tuple[Layers, Array]) -> None:
        nonlocal taken
        taken += 1
        if taken % every == 0:
            record.take(snapshot[0], snapshot[1], scales)

    fit(work, steps, take)
    return record


def prepared(table: Trajectories) -> Workload:
    """The data as arrays, with scaled inputs and initial states guessed from measurements."""
    model = gbspec.load("urp_gb2").model
    work = of_data(Size(trajectories=len(table)), model, table)
    packed = pack(table, model, MAX_STEP)
    values, seen = measured_states(model, packed)
    start = work.start.copy()
    for state in range(start.shape[1]):
        rows = np.flatnonzero(seen[:, state])[::-1]  # from last to first: the first measurement is kept
        start[packed.row_trajectory[rows], state] = values[rows, state]
    columns = [values[seen[:, state], state] for state in range(start.shape[1])] + [work.condition[:, 0]]
    center, scale = (np.array([f(column) for column in columns]) for f in (np.mean, np.std))
    return replace(work, start=start, input_center=center, input_scale=scale)


# ------------------------------------------------------------------------------------------------------------- results
def reached(curve: Sequence[Mapping[str, float]], level: float) -> float | None:
    """Processor seconds to the first snapshot at which the error was at most `level`."""
    return next((one["seconds"] for one in curve if one["error"] <= level), None)


def table_of(curves: Mapping[str, Sequence[Mapping[str, float]]]) -> str:
    """Seconds to each level, and the final error."""
    rows = []
    for name, curve in curves.items():
        times = [reached(curve, level) for level in LEVELS]
        cells = ["–" if time is None else f"{time:.0f} s" for time in times]
        last = curve[-1]
        wrong = max(abs(last[k] / v - 1) for k, v in TRUTH.items())
        rows.append([FITS[name][0], *cells, f"{last['error']:.1e}", f"{wrong:.1e}", f"{last['seconds']:.0f} s"])
    header = ["processor time to an error of", *(f"{level:g}" for level in LEVELS)]
    return markdown([*header, "last error", "B, beta within", "after"], rows)


def run_child(name: str, options: argparse.Namespace) -> list[dict[str, float]]:
    """One fit in a separate process."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.json"
        command = [sys.executable, "-m", "benchmarks.accuracy", "--fit", name, str(path)]
        command += ["--seconds", str(options.seconds), "--trajectories", str(options.trajectories)]
        done = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
        if done.returncode == MISSING:
            return []
        done.check_returncode()
        return list(json.loads(path.read_text()))


MISSING = 75
"""Exit status of a fit whose library is not installed."""


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--seconds", type=float, default=110.0, help="processor time of each fit by hand")
    options.add_argument("--trajectories", type=int, default=100)
    options.add_argument("--fits", nargs="+", choices=list(FITS), default=list(FITS))
    options.add_argument("--fit", nargs=2, help=argparse.SUPPRESS)
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes accuracy.md and accuracy.json."""
    options = arguments()
    if options.fit:
        name, path = options.fit
        torch.set_num_threads(1)
        torch.manual_seed(0)
        with pinned():
            table = data(options.trajectories)
            try:
                record = fit_gbspec(table) if name == "gbspec" else fit_by_hand(name, table, options.seconds)
            except ImportError as error:
                say(f"{name}: skipped: {error} (`pip install .[benchmarks]` installs the peers)")
                sys.exit(MISSING)
        Path(path).write_text(json.dumps(record.errors()))
        return
    curves = {name: run_child(name, options) for name in options.fits}
    curves = {name: curve for name, curve in curves.items() if curve}
    write("accuracy", "Time to a given accuracy", table_of(curves), {"curves": curves}, options.output)


if __name__ == "__main__":
    main()
