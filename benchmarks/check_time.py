"""How long `gbspec check` of a shipped model takes, beside what importing sympy alone takes, in interleaved runs.

    python benchmarks/check_time.py [--repeats 15] [MODEL ...]

Each figure is the time of a whole process; prints medians and the median ratio of neighbouring runs.
"""

from __future__ import annotations

import argparse
import statistics

from benchmarks.harness import clock, process


def main() -> None:
    """Prints one line a model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*", default=["urp_gb2", "bf_gb2", "fed_batch"])
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    print("model        check cpu s  wall s   import sympy cpu s   ratio")
    for model in options.models:
        check, alone = process("-m", "gbspec", "check", model), process("-c", "import sympy")
        pairs = [(clock(check), clock(alone)) for _ in range(options.repeats + 1)][1:]
        wall, cpu = (statistics.median(pair[0][i] for pair in pairs) for i in (0, 1))
        sympy = statistics.median(pair[1][1] for pair in pairs)
        ratio = statistics.median(pair[0][1] / pair[1][1] for pair in pairs)
        print(f"{model:12} {cpu:11.2f} {wall:7.2f} {sympy:20.2f} {ratio:7.2f}")


if __name__ == "__main__":
    main()
