"""Bifurcation diagrams of fitted reactors compared with the truth, within and far outside their training data.

    python -m benchmarks.studies.bifurcations RUNS -o docs/studies/bifurcations.md --figures docs/figures

Fits URP_BB, URP_GB1 and URP_GB2 with the sampling of their case and all defaults, with seed 1 for data and training (a
run that exists in RUNS is reused), and follows steady states and cycles over Da. All data are at B = 11 and beta = 3;
for URP_GB1, where these are constants of the model, the diagrams over B and over beta are computed too. The table has
every Hopf point with the truth's, and the largest differences of the cycles between them.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gbspec.analysis.bifurcation.diagram import Diagram
    from gbspec.runs.store import Run

SEED = 1
HEAD = """\
# Bifurcations of fitted reactors

`python -m benchmarks.studies.bifurcations RUNS -o docs/studies/bifurcations.md --figures docs/figures`, seed 1. Trained
only at B = 11, beta = 3 and Da from 0.2 to 0.5. Cycles: the largest relative errors of the period and of the largest
temperature x2, over the parameter values at which both the learned model and the truth have a stable cycle.

| model | over | Hopf point | learned | truth | off by | period | x2max |
|---|---|---|---|---|---|---|---|
"""


@dataclasses.dataclass(frozen=True)
class Question:
    """One diagram: its model, its parameter, and the values of all others."""

    model: str
    over: str
    low: float
    high: float
    values: tuple[tuple[str, float], ...] = ()

    @property
    def name(self) -> str:
        """The name of the figure."""
        return f"{self.model}_over_{self.over}"


QUESTIONS = (
    Question("urp_bb", "Da", 0.2, 0.5),
    Question("urp_gb1", "Da", 0.2, 0.5),
    Question("urp_gb2", "Da", 0.2, 0.5),
    Question("urp_gb1", "B", 9.0, 13.0, (("Da", 0.35),)),
    Question("urp_gb1", "beta", 2.0, 4.0, (("Da", 0.35),)),
)


def fitted(name: str, runs: Path) -> Run:
    """The run of a bundled model, trained unless it exists."""
    from gbspec import frontend
    from gbspec.data.cases import find_cases
    from gbspec.data.table import write
    from gbspec.diagnostics import Findings
    from gbspec.operations import fitting, models, tables
    from gbspec.training.options import TrainOptions

    directory = runs / name
    if directory.is_dir():
        return models.open_run(directory)
    model = frontend.load_model(name, Findings())
    case = find_cases(frontend.resolve(name)).of_model(name)
    table = runs / f"{name}.csv"
    runs.mkdir(parents=True, exist_ok=True)
    write(table, tables.simulate(models.reference(model), dataclasses.replace(case.sampling, seed=SEED)), model)
    data = tables.read_data(table, model, Findings())
    return fitting.train(model, data, directory, TrainOptions(seed=SEED, max_step=0.1))


def rows(question: Question, shown: Diagram, truth: Diagram) -> list[str]:
    """The table's lines for one diagram: a Hopf point each, the first with the differences of the cycles."""
    points, true = shown.of_kind("hopf"), truth.of_kind("hopf")
    if len(points) != len(true):
        return [f"| {question.model} | {question.over} | {len(points)} instead of {len(true)} | | | | | |"]
    cycles = [f"{100 * off:.2f} %" for off in differences(shown, truth)] or ["-", "-"]
    lines = []
    for i, (one, other) in enumerate(zip(points, true, strict=True)):
        off = 100 * abs(one.value / other.value - 1)
        cells = [question.model if i == 0 else "", question.over if i == 0 else "", str(i + 1)]
        cells += [f"{one.value:.6g}", f"{other.value:.6g}", f"{off:.3f} %", *(cycles if i == 0 else ["", ""])]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def differences(shown: Diagram, truth: Diagram) -> list[float]:
    """The largest relative differences of period and x2max where both have a stable cycle; empty without any."""
    both = [stable_cycles(one) for one in (shown, truth)]
    if any(len(values) < 2 for values, _ in both):
        return []
    low, high = max(values[0] for values, _ in both), min(values[-1] for values, _ in both)
    grid = np.linspace(low, high, 101)[1:-1]
    learned, true = (np.array([np.interp(grid, values, column) for column in columns]) for values, columns in both)
    return [float(off) for off in np.max(np.abs(learned / true - 1), axis=1)]


def stable_cycles(diagram: Diagram) -> tuple[np.ndarray, list[np.ndarray]]:
    """The parameter values [N] of all stable cycles, increasing, and their periods and largest x2."""
    column = diagram.states.index("x2")
    found = sorted((c.value, c.period, float(c.maximum[column])) for f in diagram.cycles for c in f.cycles if c.stable)
    values, *columns = (np.array(one) for one in zip(*found, strict=True)) if found else (np.zeros(0),) * 3
    return values, columns


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the study and writes table and figures."""
    from gbspec.operations import analysing, models, reporting
    from gbspec.report.style import save

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--figures", type=Path, required=True)
    given = parser.parse_args(arguments)
    given.figures.mkdir(parents=True, exist_ok=True)
    lines = []
    for question in QUESTIONS:
        source = models.learned(fitted(question.model, given.runs), dict(question.values))
        asked = (question.over, question.low, question.high)
        shown, truth = analysing.bifurcate(source, *asked), analysing.true_diagram(source, *asked)
        if truth is None:
            raise SystemExit(f"{question.model} has no truth")
        lines += rows(question, shown, truth)
        save(reporting.diagram_figure([shown], truth), given.figures / f"{question.name}.png")
        print("\n".join(rows(question, shown, truth)), flush=True)
    given.output.parent.mkdir(parents=True, exist_ok=True)
    given.output.write_text(HEAD + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
