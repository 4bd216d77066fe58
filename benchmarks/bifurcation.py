"""Processor time of a whole bifurcation diagram, with steady states and limit cycles.

    python -m benchmarks.bifurcation -o benchmarks/results/bifurcation.md

The truths of the two-state reactor over Da and of the six-state chemostat over its dilution rate, one core.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

QUESTIONS = (("urp_gb2", "Da", 0.2, 0.5), ("bf_gb2", "alpha", 0.18, 0.22))
HEAD = """\
`python -m benchmarks.bifurcation -o benchmarks/results/bifurcation.md`: processor time, one core, of the whole diagram.

| model | states | over | steady states | Hopf points | cycles | seconds |
|---|---|---|---|---|---|---|
"""


def line(name: str, over: str, low: float, high: float) -> str:
    """One diagram as a line of the table."""
    from gbspec import frontend
    from gbspec.diagnostics import Findings
    from gbspec.operations import analysing, models

    subject = models.reference(frontend.load_model(name, Findings()))
    began = time.process_time()
    found = analysing.bifurcate(subject, over, low, high)
    seconds = time.process_time() - began
    steady = sum(len(branch.points) for branch in found.branches)
    cycles = sum(len(family.cycles) for family in found.cycles)
    hopf = ", ".join(f"{point.value:.6g}" for point in found.of_kind("hopf"))
    cells = (name, len(found.states), f"{over} {low:g} to {high:g}", steady, hopf or "-", cycles, f"{seconds:.1f}")
    return "| " + " | ".join(map(str, cells)) + " |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the benchmark and writes the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args(arguments)
    table = HEAD + "".join(line(*question) + "\n" for question in QUESTIONS)
    given.output.write_text(table, encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
