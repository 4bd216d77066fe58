"""Timing of all benchmarks: interleaved rounds, pinned to cores, medians with quartiles, results in a table.

Every round runs each variant once in a new random order, and ratios are those of medians over the same rounds, so that
disturbances of the machine (clock rate, other processes) affect all variants alike.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import platform
import random
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median, quantiles
from typing import Any

RESULTS = Path(__file__).resolve().parent / "results"

PACKAGES = ("gbspec", "torch", "numpy", "numba", "jax", "diffrax", "optax", "torchdiffeq", "casadi")

BUSY = 0.9
"""Below this ratio of processor time to wall time of one-core runs, other processes used the machine."""


@dataclass
class Timing:
    """Seconds of repeated runs: `wall` time and `cpu` time."""

    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """Median wall time."""
        return median(self.wall)

    @property
    def quartiles(self) -> tuple[float, float]:
        """Lower and upper quartile of the wall time."""
        if len(self.wall) < 2:
            return self.wall[0], self.wall[0]
        low, _, high = quantiles(self.wall, n=4, method="inclusive")
        return low, high

    def to_json(self) -> dict[str, Any]:
        """Median and quartiles in milliseconds, the number of rounds, and the median processor time."""
        low, high = self.quartiles
        keys = {"ms": self.median, "low_ms": low, "high_ms": high}
        if self.cpu:
            keys["cpu_ms"] = median(self.cpu)
        return {name: round(1e3 * value, 4) for name, value in keys.items()} | {"rounds": len(self.wall)}


def cores() -> list[int]:
    """The cores that this process may run on, the last first: the first one serves interrupts on many machines."""
    return sorted(os.sched_getaffinity(0), reverse=True)


@contextmanager
def pinned(count: int = 1) -> Iterator[None]:
    """A context in which this thread, and threads started in it, run on `count` cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores()[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def processor_seconds() -> float:
    """Processor time so far of this process with all its threads, and of its finished child processes."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def clock(run: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor seconds of one run."""
    cpu, wall = processor_seconds(), time.perf_counter()
    run()
    return time.perf_counter() - wall, processor_seconds() - cpu


def process(*arguments: str) -> Callable[[], object]:
    """A function that runs Python with these arguments as a process without output, and raises if it fails."""
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def interleaved(
    runs: Mapping[str, Callable[[], object]],
    rounds: int,
    *,
    seconds: float = float("inf"),
    threads: Mapping[str, int] | None = None,
    seed: int = 0,
) -> dict[str, Timing]:
    """Times all `runs` once per round, in random order, after one untimed run of each.

    `threads` gives the number of cores of runs that use more than one. It stops after `rounds`, or after the round in
    which `seconds` have passed (at least one round is run).
    """
    order, shuffle = list(runs), random.Random(seed)
    for name in order:
        with pinned((threads or {}).get(name, 1)):
            runs[name]()
    timings = {name: Timing() for name in order}
    collecting = gc.isenabled()
    gc.disable()
    began = time.perf_counter()
    try:
        for _ in range(rounds):
            shuffle.shuffle(order)
            for name in order:
                with pinned((threads or {}).get(name, 1)):
                    wall, cpu = clock(runs[name])
                timings[name].wall.append(wall)
                timings[name].cpu.append(cpu)
            gc.collect()
            if time.perf_counter() - began > seconds:
                break
    finally:
        if collecting:
            gc.enable()
    return timings


def busyness(timings: Mapping[str, Timing], threads: Mapping[str, int] | None = None) -> float:
    """Processor time over wall time of the runs on one core: 1 on an idle machine; reports a far smaller one."""
    alone = [t for name, t in timings.items() if (threads or {}).get(name, 1) == 1]
    share = sum(sum(t.cpu) for t in alone) / max(sum(sum(t.wall) for t in alone), 1e-12)
    if share < BUSY:
        say(f"these runs had {100 * share:.0f} % of their core: repeat them on an idle machine")
    return share


def peak_memory(run: Callable[[], object]) -> float | None:
    """The largest growth of the process during `run` in MB (Linux; None if the kernel does not report it)."""
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
        before = _status("VmHWM")
        run()
        return (_status("VmHWM") - before) / 1024
    except (OSError, AttributeError):
        return None


def _status(name: str) -> int:
    """An entry of /proc/self/status, in kB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1])
    raise OSError(f"no {name}")


# ---------------------------------------------------------------------------------------------- the machine, results
def machine() -> dict[str, Any]:
    """Processor, cores, system and versions."""
    model, flags = platform.processor() or platform.machine(), ""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                model = value.strip()
            elif name.strip() in ("flags", "Features"):
                flags = value
    except OSError:
        pass
    known = ("avx512f", "avx2", "asimd", "sve")
    return {
        "processor": model,
        "vector": next((flag for flag in known if flag in flags.split()), ""),
        "cores": len(cores()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: found for name in PACKAGES if (found := _version(name))},
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def command() -> str:
    """The running command, as typed in a shell."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = spec.name if spec is not None else sys.argv[0]
    return " ".join(["python", *(["-m", name] if spec is not None else [name]), *sys.argv[1:]])


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; the first column is left-aligned, the others right-aligned."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (header, *rows)]
    return "\n".join([lines[0], "|---" + "|---:" * (len(header) - 1) + "|", *lines[1:]])


def write(name: str, title: str, text: str, content: Mapping[str, Any], folder: Path = RESULTS) -> None:
    """Writes `name`.json (all numbers) and `name`.md (the table, the command, the machine), and prints the table."""
    folder.mkdir(parents=True, exist_ok=True)
    here = machine()
    made = {"command": command(), "date": time.strftime("%Y-%m-%d"), "machine": here, **content}
    (folder / f"{name}.json").write_text(json.dumps(made, indent=1) + "\n")
    versions = ", ".join(f"{package} {number}" for package, number in here["versions"].items())
    about = (
        f"`{made['command']}`, {made['date']}, {here['processor']} ({here['vector']}), {here['cores']} cores, "
        f"Python {here['python']}, {versions}."
    )
    (folder / f"{name}.md").write_text(f"# {title}\n\n{text}\n\n{about}\n")
    print(text, flush=True)


def parser(description: str | None) -> argparse.ArgumentParser:
    """An argument parser with the common option `--output`."""
    made = argparse.ArgumentParser(
        description=(description or "").splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    made.add_argument("--output", type=Path, default=RESULTS, metavar="FOLDER", help="folder for the results")
    return made


def say(text: str) -> None:
    """Prints progress on standard error."""
    print(text, file=sys.stderr, flush=True)
