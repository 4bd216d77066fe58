"""The cost of a least-squares iteration: the Jacobian by kernel or graph, a damped step by sketch or factors.

    python -m benchmarks.second_order [--rounds 5] [--trajectories 200]

The workload of `benchmarks.step` (urp_gb2, an MLP 3-64-64-1, 200 trajectories, 3,900 measured values)
after four iterations of a fit, float64, one core. The timed step is the first one at its linearisation and includes
the preparations.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.harness import busyness, interleaved, markdown, parser, say, write
from benchmarks.workload import Size, Workload, make
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.engines.engine import Engine
from gbspec.training.engines.objective import linearise
from gbspec.training.optimise.levenberg_marquardt import LevenbergMarquardt, LevenbergOptions
from gbspec.training.optimise.normal_equations import NormalEquations
from gbspec.training.optimise.stage import State

ITERATIONS = 4


def fitted(work: Workload, engine: Engine) -> State:
    """The state of the second-order stage after some iterations."""
    stage = LevenbergMarquardt("fit", ITERATIONS, lambda i: engine, LevenbergOptions())
    state = stage.begin(work.theta)
    for i in range(ITERATIONS):
        state = stage.step(state, i).state
    return state


def variants(work: Workload) -> dict[str, Callable[[], object]]:
    """The timed functions; exits unless their results agree."""
    try:
        native = native_engine(work.problem, work.parameters)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    engines: dict[str, Engine] = {"kernel": native, "graph": torch_engine(work.problem, work.parameters)}
    state = fitted(work, native)
    theta, damping = state["theta"], float(state["damping"])

    def jacobian(name: str) -> Callable[[], object]:
        return lambda: linearise(engines[name], theta)

    def step(sketched: bool) -> Callable[[], object]:
        system = linearise(native, theta)
        ones = np.ones(len(system.residuals))

        def run() -> object:
            equations = NormalEquations(system, work.parameters, ones, 0.0, theta)
            if not sketched:
                equations.sketch = None
            return equations.step(damping)

        return run

    one, other = (linearise(engine, theta).shared for engine in engines.values())
    if float((one - other).abs().max()) > 1e-10 * float(other.abs().max()):
        raise SystemExit("kernel and graph have different Jacobians")
    a, b = (np.asarray(step(sketched)()) for sketched in (True, False))
    if np.linalg.norm(a - b) > 1e-6 * np.linalg.norm(b):
        raise SystemExit("sketch and factors have different steps")
    differ = np.linalg.norm(a - b) / np.linalg.norm(b)
    say(f"{tuple(one.shape)} shared columns, damping {damping:.2g}, steps differ by {differ:.1e}")
    return {
        "Jacobian, kernel": jacobian("kernel"),
        "Jacobian, graph": jacobian("graph"),
        "step, sketch": step(True),
        "step, factors": step(False),
    }


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=5)
    options.add_argument("--trajectories", type=int, default=200)
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes second_order.md and second_order.json."""
    options = arguments()
    torch.set_num_threads(1)
    timings = interleaved(variants(make(Size(trajectories=options.trajectories))), options.rounds)
    found = {name: timing.to_json() for name, timing in timings.items()}
    rows = []
    for name, entry in found.items():
        what = name.split(",")[0]
        least = min(other["cpu_ms"] for title, other in found.items() if title.startswith(what))
        rows.append([name, f"{entry['ms']:.0f}", f"{entry['cpu_ms']:.0f}", f"{entry['cpu_ms'] / least:.1f}"])
    text = markdown(["", "ms", "cpu ms", "times the faster"], rows)
    write(
        "second_order",
        "What an iteration of least squares costs",
        text,
        {"busyness": busyness(timings), "timings": found},
        options.output,
    )


if __name__ == "__main__":
    main()
