"""Growth of the time of a training step with trajectories, length, width of the network and number of states.

    python -m benchmarks.growth [--rounds 3] [--axes trajectories length width states] [--variants native torch …]

One size is varied at a time; the others are 200 trajectories, span 10, width 64 and two states (further states form a
chain). float32, one core. Cases that would take too long or too much memory are skipped, with a message.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import torch

from benchmarks.harness import busyness, interleaved, markdown, parser, say, write
from benchmarks.variants import VARIANTS, Dtype, agree, build
from benchmarks.workload import Size, Workload, make

AXES: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "trajectories": ("trajectories", (20, 200, 2000, 20000)),
    "length": ("span", (2.5, 10, 40)),
    "width": ("width", (16, 64, 256)),
    "states": ("states", (2, 8, 32)),
}
"""The varied sizes and their values."""

SIMULATED = 50
"""Most trajectories that are simulated; further ones repeat them."""

COMPARED = 100_000
"""Most sub-steps for which gradients are compared: the reference stores all activations."""

STORING = ("graph", "jax", "torch", "torch-naive", "torch-aligned", "torchdiffeq", "torchdiffeq-packed")
"""Variants that store all activations of all sub-steps."""


def dtype_of(name: str) -> Dtype:
    """float32 if the variant has it."""
    return VARIANTS[name].dtypes[0]


def needed_gb(name: str, work: Workload) -> float:
    """Estimated GB of a step: the storing variants keep six arrays of the width per Runge-Kutta stage of a sub-step."""
    if name not in STORING:
        return 0.0
    size = 4 if dtype_of(name) == "float32" else 8
    return 6 * 4 * work.size.width * size * work.substeps / 1e9


def available_gb() -> float:
    """Free memory of the machine."""
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9


def case(size: Size, names: Sequence[str], before: Mapping[str, float], rounds: int, most: float) -> dict[str, Any]:
    """Milliseconds by variant at one size; `before` has the expected seconds per floating point operation."""
    work = make(size, SIMULATED)
    chosen, left_out = [], {}
    for name in names:
        seconds, memory = before.get(name, 0.0) * work.flop, needed_gb(name, work)
        if seconds > most:
            left_out[name] = f"about {seconds:.0f} s a step"
        elif memory > 0.6 * available_gb():
            left_out[name] = f"about {memory:.0f} GB"
        else:
            chosen.append(name)
    candidates = [c for name in chosen for c in build(work, [name], [dtype_of(name)])]
    if work.substeps <= COMPARED:
        agree(work, candidates)
    timings = interleaved({c.name: c.run for c in candidates}, rounds, seconds=3 * most)
    return {
        "size": asdict(size),
        "substeps": work.substeps,
        "flop": work.flop,
        "busyness": round(busyness(timings), 3),
        "timings": {name: timing.to_json() for name, timing in timings.items()},
        "left_out": left_out,
    }


def grow(axis: str, names: Sequence[str], rounds: int, most: float) -> list[dict[str, Any]]:
    """The cases of one axis."""
    attribute, values = AXES[axis]
    cases: list[dict[str, Any]] = []
    before: dict[str, float] = {}
    for value in values:
        size = replace(Size(), **{attribute: type(getattr(Size(), attribute))(value)})
        cases.append(case(size, names, before, rounds, most))
        before |= {name: 1e-3 * t["ms"] / cases[-1]["flop"] for name, t in cases[-1]["timings"].items()}
        times = ", ".join(f"{name} {t['ms']:.1f} ms" for name, t in cases[-1]["timings"].items())
        say(f"{axis} {value:g}: {times}" + "".join(f", {n} skipped ({w})" for n, w in cases[-1]["left_out"].items()))
    return cases


def table(axes: Mapping[str, Sequence[Mapping[str, Any]]], names: Sequence[str]) -> str:
    """One row per case: milliseconds by variant."""
    rows = []
    for axis, cases in axes.items():
        for found in cases:
            cells = []
            for name in names:
                timing = found["timings"].get(name)
                cells.append(found["left_out"].get(name, "") if timing is None else f"{timing['ms']:.1f}")
            value = found["size"][AXES[axis][0]]
            rows.append([f"{axis} {value:g}", f"{found['substeps']}", *cells])
    titles = [f"{VARIANTS[name].title}, {'f32' if dtype_of(name) == 'float32' else 'f64'} ms" for name in names]
    return markdown(["", "sub-steps", *titles], rows)


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--axes", nargs="+", choices=list(AXES), default=list(AXES))
    chosen = ["native", "jax-checkpoint", "torch"]
    options.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=chosen, metavar="NAME")
    options.add_argument("--most", type=float, default=10.0, help="seconds that a step may take")
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes growth.md and growth.json."""
    options = arguments()
    torch.set_num_threads(1)
    axes = {axis: grow(axis, options.variants, options.rounds, options.most) for axis in options.axes}
    measured = [n for n in options.variants if any(n in c["timings"] for cases in axes.values() for c in cases)]
    write("growth", "How a training step grows", table(axes, measured), {"axes": axes}, options.output)


if __name__ == "__main__":
    main()
