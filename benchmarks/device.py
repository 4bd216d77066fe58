"""One training step and one Jacobian on a GPU, compared with the torch graph and the kernel on the processor.

    python -m benchmarks.device [--rounds 3] [--trajectories 20 200 2000 20000] [--widths 64 256] [--most 10]

The workload of `benchmarks.step` with more trajectories and wider networks. The processor's variants use all its
cores. Ratios are of medians over the same interleaved rounds; the gradient on the GPU is compared with the graph's in
float64 on the processor first. Variants that would take longer than `--most` seconds are skipped.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from benchmarks.harness import cores, interleaved, markdown, parser, say, write
from benchmarks.own import precision_of
from benchmarks.workload import Size, Workload, make
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.engines.engine import Engine
from gbspec.training.engines.objective import linearise, loss_and_gradient

PLACES = ("kernel", "graph", "GPU")
SIMULATED = 50
JACOBIAN_BYTES = 4e9
"""Larger Jacobians are not computed in training either (`--method auto` takes Adam then)."""


def engine(work: Workload, place: str, dtype: torch.dtype) -> Engine:
    """The engine at a place, in a precision."""
    if place == "kernel":
        return native_engine(work.problem, work.parameters, precision_of(dtype))
    return torch_engine(work.problem, work.parameters, "cuda" if place == "GPU" else "cpu", precision_of(dtype))


def agree(work: Workload) -> dict[str, float]:
    """Relative differences of the GPU's gradients from the graph's in float64; exits where they are too large."""
    _, expected = loss_and_gradient(engine(work, "graph", torch.float64), work.theta)
    found = {}
    for dtype, most in ((torch.float64, 1e-9), (torch.float32, 1e-3)):
        _, gradient = loss_and_gradient(engine(work, "GPU", dtype), work.theta)
        error = float(np.linalg.norm(gradient - expected) / np.linalg.norm(expected))
        if not error < most:
            raise SystemExit(f"the gradient on the GPU is wrong by {error:.1e} in {precision_of(dtype)}")
        found[precision_of(dtype)] = error
    return found


def variants(work: Workload) -> dict[str, Callable[[], object]]:
    """The timed functions by task, precision and place."""
    made: dict[str, Callable[[], object]] = {}
    for dtype in (torch.float64, torch.float32):
        for place in PLACES:
            one = engine(work, place, dtype)
            made[f"gradient, {precision_of(dtype)}, {place}"] = lambda one=one: loss_and_gradient(one, work.theta)
    if work.measured * work.parameters.n_shared * 8 < JACOBIAN_BYTES:
        for place in PLACES:
            one = engine(work, place, torch.float64)
            made[f"Jacobian, float64, {place}"] = lambda one=one: linearise(one, work.theta)
    return made


def case(size: Size, before: dict[str, float], options: argparse.Namespace) -> dict[str, Any]:
    """Milliseconds by variant at one size; `before` has the seconds per floating point operation so far."""
    work = make(size, SIMULATED)
    differences = agree(work) if size.trajectories <= 200 else {}
    runs = {n: run for n, run in variants(work).items() if before.get(n, 0.0) * work.flop < options.most}
    threads = dict.fromkeys(runs, len(cores()))
    timings = interleaved(runs, options.rounds, threads=threads, seconds=3 * options.most)
    for name, timing in timings.items():
        # A GPU needs as long to launch an operation of any size: only the processor's times grow with the flop.
        before[name] = 0.0 if name.endswith("GPU") else timing.median / work.flop
    said = ", ".join(f"{name} {1e3 * timing.median:.0f} ms" for name, timing in timings.items())
    say(f"{size.trajectories} trajectories, width {size.width}: {said}")
    found = {name: timing.to_json() for name, timing in timings.items()}
    return {"trajectories": size.trajectories, "width": size.width, "differences": differences, "timings": found}


def table(cases: list[dict[str, Any]]) -> str:
    """A row for each size and task: milliseconds by place, and how many times faster the GPU is."""
    rows = []
    for one in cases:
        timings: Mapping[str, Any] = one["timings"]
        for task in dict.fromkeys(name.rsplit(", ", 1)[0] for name in timings):
            ms = {place: timings[f"{task}, {place}"]["ms"] for place in PLACES if f"{task}, {place}" in timings}
            of = [f"{ms[p] / ms['GPU']:.2f}" if p in ms and "GPU" in ms else "" for p in ("kernel", "graph")]
            cells = [f"{ms[place]:.1f}" if place in ms else "" for place in PLACES]
            rows.append([f"{one['trajectories']}", f"{one['width']}", task, *cells, *of])
    header = ["trajectories", "width", "", "kernel, ms", "graph, ms", "GPU, ms", "kernel / GPU", "graph / GPU"]
    return markdown(header, rows)


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--trajectories", type=int, nargs="+", default=[20, 200, 2000, 20000])
    options.add_argument("--widths", type=int, nargs="+", default=[64, 256])
    options.add_argument("--most", type=float, default=10.0, help="seconds that a variant may take")
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes device.md and device.json."""
    options = arguments()
    if not torch.cuda.is_available():
        raise SystemExit("torch finds no GPU on this machine")
    torch.set_num_threads(len(cores()))
    cases = []
    for width in options.widths:
        before: dict[str, float] = {}
        cases += [case(Size(count, width=width), before, options) for count in options.trajectories]
    gpu = torch.cuda.get_device_name()
    text = f"{table(cases)}\n\nGPU: {gpu}; processor: {len(cores())} cores."
    write("device", "A GPU compared with the processor", text, {"gpu": gpu, "cases": cases}, options.output)


if __name__ == "__main__":
    main()
