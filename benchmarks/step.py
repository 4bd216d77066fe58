"""One training step, forward and backward over all data, in gbspec and its peers: time, distance to the limit, memory.

    python -m benchmarks.step [--rounds 9] [--seconds 80] [--variants native torch …]

The limit is the time of the necessary matrix products only, at the rate measured in the same rounds for products of the
shape that a step consists of (trajectories x width x width), by torch or by NumPy, whichever is faster on the
processor. Every variant's gradient is compared with that of gbspec's torch graph before it is timed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from benchmarks import own
from benchmarks.harness import busyness, interleaved, markdown, parser, peak_memory, pinned, say, write
from benchmarks.variants import VARIANTS, Candidate, Dtype, agree, build, prepare_jax
from benchmarks.workload import Size, Workload, make

DTYPES: tuple[Dtype, ...] = ("float32", "float64")

PRODUCTS = 200
"""Number of matrix products in a run that measures the limit."""

TINY = Size(trajectories=4, span=2.0)


def limits(work: Workload, dtype: Dtype) -> tuple[dict[str, Callable[[], object]], float]:
    """Runs of matrix products of a step's shape, by library, and the factor from their time to the limit."""
    n, width = work.size.trajectories, work.size.width
    a, b, out = (torch.rand(shape, dtype=getattr(torch, dtype)) for shape in ((n, width), (width, width), (n, width)))
    x, y, z = a.numpy(), b.numpy(), out.numpy()

    def by_torch() -> None:
        for _ in range(PRODUCTS):
            torch.mm(a, b, out=out)

    def by_numpy() -> None:
        for _ in range(PRODUCTS):
            np.matmul(x, y, out=z)

    return {"torch": by_torch, "numpy": by_numpy}, work.flop / (PRODUCTS * 2.0 * n * width**2)


def measure(work: Workload, candidates: Sequence[Candidate], rounds: int, seconds: float) -> dict[str, Any]:
    """Timings by label, and the limits by precision in milliseconds."""
    products = {dtype: limits(work, dtype) for dtype in DTYPES}
    runs = {c.label: c.run for c in candidates}
    for dtype, (by_library, _) in products.items():
        runs |= {f"limit {dtype} {library}": run for library, run in by_library.items()}
    threads = {c.label: c.variant.threads for c in candidates}
    timings = interleaved(runs, rounds, seconds=seconds, threads=threads)
    rates = {d: {k: timings[f"limit {d} {k}"].median for k in by_library} for d, (by_library, _) in products.items()}
    return {
        "limit_ms": {d: 1e3 * factor * min(rates[d].values()) for d, (_, factor) in products.items()},
        "busyness": round(busyness(timings, threads), 3),
        "timings": {label: timings[label].to_json() for label in threads},
    }


def memory_of(name: str, dtype: Dtype, size: Size) -> float | None:
    """MB by which a fresh process grows in the first step, after a step of a tiny workload that loads all libraries."""
    arguments = [sys.executable, "-m", "benchmarks.step", "--memory-of", name, dtype]
    sizes = ["--trajectories", str(size.trajectories), "--span", str(size.span)]
    # Blocks above 64 kB are allocated from and returned to the system, so that memory freed before is not reused.
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
    done = subprocess.run([*arguments, *sizes], capture_output=True, text=True, env=environment)
    if done.returncode != 0:
        raise RuntimeError(f"the memory of {name} could not be measured:\n{done.stderr}")
    found = json.loads(done.stdout)
    return None if found is None else float(found)


def _memory(name: str, dtype: Dtype, size: Size) -> None:
    prepare_jax()
    with pinned(VARIANTS[name].threads):
        VARIANTS[name].build(make(TINY), dtype)()
        own.release()
        run = VARIANTS[name].build(make(size, simulated=20), dtype)
        print(json.dumps(peak_memory(run)))


# ------------------------------------------------------------------------------------------------------------ table
def quickest_first(timings: Mapping[str, Any]) -> list[str]:
    """Names of the variants, ordered by the smaller time of their precisions."""
    best: dict[str, float] = {}
    for label, found in timings.items():
        name = label.partition(" ")[0]
        best[name] = min(found["ms"], best.get(name, found["ms"]))
    return sorted(best, key=lambda name: best[name])


def table(result: Mapping[str, Any]) -> str:
    """The results in Markdown, fastest first."""
    timings, limits = result["timings"], result["limit_ms"]

    def cells(name: str, dtype: str) -> list[str]:
        found = timings.get(f"{name} {dtype}")
        if found is None:
            return ["", "", ""]
        quartiles = f"{found['low_ms']:.1f}–{found['high_ms']:.1f}"
        return [f"{found['ms']:.1f}", quartiles, f"{found['ms'] / limits[dtype]:.2f}"]

    rows = []
    for name in quickest_first(timings):
        used = result["memory_mb"].get(name)
        memory = "" if used is None else f"{used:.1f}"
        rows.append([VARIANTS[name].title, *cells(name, "float32"), *cells(name, "float64"), memory])
    header = ["variant", "f32 ms", "quartiles", "x limit", "f64 ms", "quartiles", "x limit", "peak MB"]
    shape = result["workload"]
    about = (
        f"{shape['trajectories']} trajectories, {shape['measured']} measured values, {shape['substeps']} sub-steps, "
        f"{shape['flop'] / 1e9:.3f} GFLOP in matrix products; limit {limits['float32']:.1f} ms in float32, "
        f"{limits['float64']:.1f} ms in float64. One core unless it says otherwise; medians of {result['rounds']} "
        f"interleaved rounds; processor time over wall time {result['busyness']:.2f}. Peak memory of a step in float32 "
        "(float64 where a variant has no other)."
    )
    return f"{about}\n\n{markdown(header, rows)}"


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=9)
    options.add_argument("--seconds", type=float, default=80.0, help="no round starts after this number of seconds")
    options.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS), metavar="NAME")
    options.add_argument("--trajectories", type=int, default=200)
    options.add_argument("--span", type=float, default=10.0)
    options.add_argument("--no-memory", action="store_true", help="do not measure peak memory")
    options.add_argument("--memory-of", nargs=2, help=argparse.SUPPRESS)
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes step.md and step.json."""
    options = arguments()
    torch.set_num_threads(1)
    size = Size(trajectories=options.trajectories, span=options.span)
    if options.memory_of:
        _memory(*options.memory_of, size)
        return
    work = make(size)
    candidates = build(work, options.variants, DTYPES, say)
    agree(work, candidates, say)
    result = measure(work, candidates, options.rounds, options.seconds)
    memory: dict[str, float | None] = {}
    for candidate in [] if options.no_memory else candidates:
        if candidate.name not in memory:
            memory[candidate.name] = memory_of(candidate.name, candidate.dtype, size)
            say(f"{candidate.name}: peak memory {memory[candidate.name]} MB")
    result |= {
        "memory_mb": memory,
        "rounds": max(t["rounds"] for t in result["timings"].values()),
        "workload": {
            "trajectories": size.trajectories,
            "measured": work.measured,
            "substeps": work.substeps,
            "flop": work.flop,
        },
    }
    write("step", "A training step", table(result), result, options.output)


if __name__ == "__main__":
    main()
