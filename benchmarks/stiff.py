"""Loss and gradient of a stiff model at equal error: gbspec's kernel, diffrax's Kvaerno methods, CasADi's CVODES.

    python -m benchmarks.stiff [--rounds 9] [--seconds 60] [--target 1e-6]

Robertson's reaction, 16 trajectories over ten decades of time, with known equations and with its fast rate as a network
of 64 and 64 (`stiff_workload`), float64, one core. Each solver gets the tolerance of a ladder at which the error of its
solution is nearest the target; errors are relative to a solution by scipy's Radau method at a tolerance of 1e-10. The
times are of one loss with its gradient by all rates, starts and weights, at a new vector, with the choice of the steps.
"""

from __future__ import annotations

import argparse
import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import torch

from benchmarks.harness import busyness, interleaved, markdown, parser, say, write
from benchmarks.stiff_workload import StiffWork, make
from benchmarks.variants import prepare_jax
from benchmarks.workload import Array
from gbspec.training.engines.engine import Engine
from gbspec.training.engines.objective import loss_and_gradient, native_engine, predicted

OURS = "ros34pw2"
TITLES = {
    OURS: "**gbspec, native kernel, `ros34pw2`**",
    f"{OURS} planning": "of it the choice of the steps",
    "Kvaerno3": "diffrax `Kvaerno3`",
    "Kvaerno5": "diffrax `Kvaerno5`",
    "CVODES adjoint": "CasADi `cvodes`, adjoint",
    "CVODES forward": "CasADi `cvodes`, forward",
}
FORWARD = 100
"""Forward sensitivities are not computed for more parameters than these."""
LADDER = tuple(10.0 ** (-i / 4) for i in range(14, 37))
"""Tolerances, from 3e-4 to 1e-9."""
AGREE = 1e-3
"""Largest distance of a gradient from gbspec's, relative to its norm: both have the error of their solutions."""


@dataclass(frozen=True)
class Chosen:
    """A solver at its tolerance: the error, the mean number of steps, loss and gradient, and what is timed."""

    rtol: float
    error: float
    steps: float
    found: tuple[float, Array]
    runs: Mapping[str, Callable[[], object]]


def nearest(errors: Mapping[float, float], target: float) -> float:
    """The tolerance whose error is nearest the target on a scale of logarithms; raises ValueError if none is finite."""
    finite = {rtol: error for rtol, error in errors.items() if np.isfinite(error) and error > 0}
    if not finite:
        raise ValueError("no tolerance of the ladder has a solution")
    return min(finite, key=lambda rtol: abs(np.log(finite[rtol] / target)))


def ladder(error: Callable[[float], float], target: float) -> dict[float, float]:
    """Errors by tolerance, down to a twentieth of the target."""
    errors: dict[float, float] = {}
    for rtol in LADDER:
        errors[rtol] = error(rtol)
        if errors[rtol] < target / 20:
            break
    return errors


def states_of(work: StiffWork, engine: Engine) -> Array:
    """The states [N, T, 3] at the rows."""
    packed, found = work.problem.packed, np.zeros_like(work.value)
    found[packed.row_trajectory, packed.row_index] = predicted(engine, work.theta).mean
    return found


def moving(work: StiffWork) -> Callable[[], Array]:
    """Vectors that differ by rounding, so that steps are chosen again in each call, as in a fit."""
    count = 0

    def following() -> Array:
        nonlocal count
        count += 1
        return np.asarray(work.theta + 1e-13 * count)

    return following


def ours(work: StiffWork, exact: Array, target: float) -> Chosen:
    """gbspec's kernel."""

    def engine(rtol: float) -> Engine:
        return native_engine(work.controlled(rtol), work.parameters)

    errors = ladder(lambda rtol: work.off(states_of(work, engine(rtol)), exact), target)
    rtol, theta = nearest(errors, target), moving(work)
    best = engine(rtol)
    steps = best.plan(work.theta).packed.substeps / len(work.start)
    loss, gradient = loss_and_gradient(best, work.theta)
    runs = {OURS: lambda: loss_and_gradient(best, theta()), f"{OURS} planning": lambda: best.plan(theta())}
    return Chosen(rtol, errors[rtol], steps, (loss, work.natural(gradient)), runs)


def peer(work: StiffWork, exact: Array, target: float, name: str) -> Chosen:
    """A method of another library; raises ImportError without it, FailedError where it gives no gradient."""
    made = maker(work, name)
    errors = ladder(lambda rtol: work.off(made.states(rtol)[0], exact), target)
    rtol = nearest(errors, target)
    try:
        loss, gradient = made.step(rtol)()
    except RuntimeError as error:  # jax raises subclasses of it
        raise FailedError(f"{name} has no gradient at {rtol:.1e}, error {errors[rtol]:.1e}: {reason(error)}") from error
    return Chosen(rtol, errors[rtol], made.states(rtol)[1], (float(loss), gradient), {name: made.step(rtol)})


class Peer(Protocol):
    """A solver of another library."""

    def states(self, rtol: float) -> tuple[Array, float]:
        """States [N, T, 3] and the mean number of steps (NaN: not known)."""

    def step(self, rtol: float) -> Callable[[], tuple[float, Array]]:
        """Loss and gradient, in the order of `StiffWork.natural`, as a call without arguments."""


def maker(work: StiffWork, name: str) -> Peer:
    """The solver of this name."""
    if name.startswith("CVODES"):
        from benchmarks.peers import casadi_cvodes

        kind: Literal["adjoint", "forward"] = "adjoint" if name.endswith("adjoint") else "forward"
        if kind == "forward" and work.theta.size > FORWARD:
            raise FailedError(f"{TITLES[name]}: not timed with {work.theta.size} parameters")
        return casadi_cvodes.Peer(work, kind)
    from benchmarks.peers import diffrax_stiff

    return diffrax_stiff.Peer(work, name)


class FailedError(RuntimeError):
    """A solver has a solution but no gradient."""


def reason(error: Exception) -> str:
    """The sentence of a library's error that says what happened."""
    found = re.search(r"\w+Error: ([^.:]+)\.", str(error))
    return found.group(1) if found else str(error).partition("\n")[0]


def chosen(work: StiffWork, target: float, names: tuple[str, ...]) -> tuple[dict[str, Chosen], list[str]]:
    """All solvers at their tolerances, and why others have no gradient; those whose library is missing are skipped."""
    exact, failed = work.exact, []
    found = {OURS: ours(work, exact, target)}
    for name in names:
        try:
            found[name] = peer(work, exact, target, name)
        except ImportError as error:
            say(f"{name}: skipped: {error} (`pip install .[benchmarks]` installs the peers)")
        except FailedError as error:
            say(str(error))
            failed.append(str(error))
    return found, failed


def distance(one: tuple[float, Array], other: tuple[float, Array]) -> float:
    """The larger of the relative differences of loss and gradient."""
    return max(abs(one[0] / other[0] - 1), float(np.linalg.norm(one[1] - other[1]) / np.linalg.norm(other[1])))


def measure(work: StiffWork, target: float, names: tuple[str, ...], rounds: int, seconds: float) -> dict[str, Any]:
    """Tolerances, errors, timings and ratios by solver; exits if the gradients disagree."""
    found, failed = chosen(work, target, names)
    timings = interleaved({k: run for c in found.values() for k, run in c.runs.items()}, rounds, seconds=seconds)
    mine = np.array(timings[OURS].cpu)
    out: dict[str, Any] = {}
    for name, one in found.items():
        apart = distance(one.found, found[OURS].found)
        if not apart <= AGREE:
            raise SystemExit(f"{name} has another loss or gradient: {apart:.1e}")
        shares = mine / np.array(timings[name].cpu)
        low, middle, high = np.quantile(shares, (0.25, 0.5, 0.75))
        out[name] = {
            "rtol": one.rtol,
            "error": one.error,
            "steps": one.steps if np.isfinite(one.steps) else None,
            "apart": apart,
            "timing": timings[name].to_json(),
            "share": {"median": middle, "low": low, "high": high},
        }
    out[OURS]["planning"] = timings[f"{OURS} planning"].to_json()
    return {"solvers": out, "failed": failed, "busyness": round(busyness(timings), 3)}


# ------------------------------------------------------------------------------------------------------------ table
def rows(result: Mapping[str, Any], label: str) -> list[list[str]]:
    """The lines of a workload."""
    lines = []
    for name, one in result["solvers"].items():
        t, share = one["timing"], one["share"]
        steps = "" if one["steps"] is None else f"{one['steps']:.0f}"
        cells = [f"{label}: {TITLES[name]}", f"{one['rtol']:.1e}", f"{one['error']:.1e}", steps]
        cells += [f"{t['cpu_ms']:.1f}", f"{t['ms']:.1f}", f"{t['low_ms']:.1f}–{t['high_ms']:.1f}"]
        ratio = f"{share['median']:.3f} ({share['low']:.3f}–{share['high']:.3f})"
        lines.append([*cells, "" if name == OURS else ratio])
        if "planning" in one:
            t, title = one["planning"], TITLES[f"{OURS} planning"]
            times = [f"{t['cpu_ms']:.1f}", f"{t['ms']:.1f}", f"{t['low_ms']:.1f}–{t['high_ms']:.1f}"]
            lines.append([f"{label}: {title}", "", "", "", *times, ""])
    return lines


def table(result: Mapping[str, Any]) -> str:
    """The results in Markdown."""
    header = ["solver", "tolerance", "error", "steps", "CPU ms", "wall ms", "quartiles", "gbspec's time / its time"]
    lines = [line for label, found in result["workloads"].items() for line in rows(found, label)]
    busy = min(found["busyness"] for found in result["workloads"].values())
    about = (
        f"Robertson's reaction, {result['trajectories']} trajectories, 50 rows from 1e-5 to 1e5 s of all states; loss "
        "and gradient by rates, starts and, with a network of 64 and 64, its weights. Tolerances whose largest error "
        f"in any row is nearest {result['target']:.0e}, relative to |x| + 0.1 of the state's scale; mean accepted "
        "steps of a trajectory (of diffrax all tried ones; CasADi tells none). One core, float64; medians of "
        "interleaved rounds and, in "
        f"brackets, quartiles of the ratio of processor times within a round; processor time over wall time {busy:.2f}."
    )
    failed = [f"{label}: {text}." for label, found in result["workloads"].items() for text in found["failed"]]
    return "\n\n".join([about, markdown(header, lines), *failed])


def arguments() -> argparse.Namespace:
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=9)
    options.add_argument("--seconds", type=float, default=60.0, help="no round starts after this number of seconds")
    options.add_argument("--target", type=float, default=1e-6, help="the error at which solvers are compared")
    options.add_argument("--trajectories", type=int, default=16)
    options.add_argument(
        "--peers", nargs="*", default=[name for name in TITLES if not name.startswith(OURS)], metavar="NAME"
    )
    return options.parse_args()


def main() -> None:
    """Runs the benchmark and writes stiff.md and stiff.json."""
    options = arguments()
    torch.set_num_threads(1)
    prepare_jax()
    logging.getLogger("jax").setLevel(logging.CRITICAL)  # of a failure, it prints what the exception says
    workloads = {}
    for label, width in {"known": None, "network": 64}.items():
        work = make(width, options.trajectories)
        say(f"{label}: {work.theta.size} parameters")
        workloads[label] = measure(work, options.target, tuple(options.peers), options.rounds, options.seconds)
    result = {"target": options.target, "trajectories": options.trajectories, "workloads": workloads}
    write("stiff", "Loss and gradient of a stiff model", table(result), result, options.output)


if __name__ == "__main__":
    main()
