"""Waiting times before any computation: start-up, check, compile, and the compilation of training steps.

    python -m benchmarks.startup [--rounds 3] [--no-peers]

Commands are timed as whole processes, and compared with importing only sympy or torch. Kernels are built in a process
that has imported everything; "cached" is the same in another process that finds the compiled one.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.harness import Timing, busyness, interleaved, markdown, parser, pinned, process, say, write
from benchmarks.variants import VARIANTS, Dtype

MODEL = "urp_gb2"

COMPILED: Mapping[str, Sequence[Dtype]] = {"jax-checkpoint": ("float32",), "diffrax": ("float32",)}
"""Peers whose step is compiled by XLA, and the precision in which it is timed."""

KERNEL = """
import time, gbspec, torch
from gbspec.backends.module import load_module
from gbspec.training.engines.native.kernel import kernel_of
model = gbspec.load("{model}").model
module = load_module(model)
began = time.perf_counter()
kernel = kernel_of(model, module, "{dtype}")
assert not isinstance(kernel, str), kernel
print(time.perf_counter() - began)
"""

STEP = """
import importlib, time
from benchmarks.variants import VARIANTS, prepare_jax
from benchmarks.workload import Size, make
work = make(Size(), simulated=20)
prepare_jax()
importlib.import_module(VARIANTS["{name}"].module)
began = time.perf_counter()
VARIANTS["{name}"].build(work, "{dtype}")
print(time.perf_counter() - began)
"""


def commands(folder: str) -> dict[str, list[str]]:
    """The processes to time: arguments of Python by title."""
    run = ["-m", "gbspec"]
    return {
        "`import sympy` alone": ["-c", "import sympy"],
        "`import torch` alone": ["-c", "import torch"],
        "`gbspec --version`": [*run, "--version"],
        f"`gbspec check {MODEL}`": [*run, "check", MODEL],
        f"`gbspec compile {MODEL}`": [*run, "compile", MODEL, "-o", f"{folder}/model.py"],
        "import of the compiled module": ["-c", f"import sys; sys.path.insert(0, {folder!r}); import model"],
    }


def told(program: str, **environment: str) -> float:
    """The number of seconds that a program prints."""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env={**os.environ, **environment}
    )
    if done.returncode != 0:
        raise RuntimeError(done.stderr)
    return float(done.stdout.split()[-1])


def kernels(rounds: int) -> dict[str, Timing]:
    """Times of generating and compiling the native kernel, and of finding it in the cache."""
    out: dict[str, Timing] = {}
    for dtype in ("float32", "float64"):
        program = KERNEL.format(model=MODEL, dtype=dtype)
        cold, cached = Timing(), Timing()
        for _ in range(rounds):
            with tempfile.TemporaryDirectory() as cache:
                cold.wall.append(told(program, GBSPEC_CACHE=cache))
                cached.wall.append(told(program, GBSPEC_CACHE=cache))
        out[f"native kernel, {dtype}, cold"], out[f"native kernel, {dtype}, cached"] = cold, cached
    return out


def peers(rounds: int) -> dict[str, Timing]:
    """Times of tracing and compiling a step with XLA."""
    out = {}
    for name, dtypes in COMPILED.items():
        for dtype in dtypes:
            try:
                importlib.import_module(VARIANTS[name].module)
            except ImportError as error:
                say(f"{name}: skipped: {error} (`pip install .[benchmarks]` installs the peers)")
                continue
            timing = Timing([told(STEP.format(name=name, dtype=dtype)) for _ in range(rounds)])
            out[f"{VARIANTS[name].title}, {dtype}: trace and compile"] = timing
    return out


def table(result: Mapping[str, Any]) -> str:
    """A table of wall times, and of processor times of processes."""
    rows = [
        [
            title,
            f"{found['ms'] / 1e3:.2f} s",
            f"{found['low_ms'] / 1e3:.2f}–{found['high_ms'] / 1e3:.2f}",
            f"{found['cpu_ms'] / 1e3:.2f} s" if "cpu_ms" in found else "",
        ]
        for title, found in result["timings"].items()
    ]
    return markdown(["", "wall time", "quartiles", "processor time"], rows)


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--kernel-rounds", type=int, default=1)
    options.add_argument("--no-peers", action="store_true")
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes startup.md and startup.json."""
    options = arguments()
    with tempfile.TemporaryDirectory() as folder, pinned():
        made = commands(folder)
        subprocess.run([sys.executable, *made[f"`gbspec compile {MODEL}`"]], check=True, capture_output=True)
        timings = interleaved({title: process(*command) for title, command in made.items()}, options.rounds)
        quiet = busyness(timings)
        timings |= kernels(options.kernel_rounds)
        if not options.no_peers:
            timings |= peers(1)
    result = {"busyness": round(quiet, 3), "timings": {title: t.to_json() for title, t in timings.items()}}
    write("startup", "Start-up, check and compile times", table(result), result, options.output)


if __name__ == "__main__":
    main()
