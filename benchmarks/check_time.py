"""How long `gbspec check` of a shipped model takes, beside what importing sympy alone takes, in interleaved runs.

    python benchmarks/check_time.py [--repeats 15] [MODEL ...]

Each figure is the time of a whole process; prints medians and the median ratio of neighbouring runs.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time


def seconds(command: list[str]) -> tuple[float, float]:
    """Processor and wall time of a finished command."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    after, end = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, end - begin


def main() -> None:
    """Prints one line a model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*", default=["urp_gb2", "bf_gb2", "fed_batch"])
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    print("model        check cpu s  wall s   import sympy cpu s   ratio")
    for model in options.models:
        check = [sys.executable, "-m", "gbspec", "check", model]
        pairs = [(seconds(check), seconds([sys.executable, "-c", "import sympy"])) for _ in range(options.repeats + 1)][
            1:
        ]
        cpu, wall = (statistics.median(pair[0][i] for pair in pairs) for i in (0, 1))
        sympy = statistics.median(pair[1][0] for pair in pairs)
        ratio = statistics.median(pair[0][0] / pair[1][0] for pair in pairs)
        print(f"{model:12} {cpu:11.2f} {wall:7.2f} {sympy:20.2f} {ratio:7.2f}")


if __name__ == "__main__":
    main()
