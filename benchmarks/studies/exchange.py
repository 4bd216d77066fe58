"""Round trips of all bundled models: export to SBML and PEtab, import, and what differs.

python -m benchmarks.studies.exchange -o docs/studies/exchange.md
"""

from __future__ import annotations

import argparse
import signal
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import gbspec
from gbspec.backends import Evaluator, load_module
from gbspec.data import Trajectories, shipped_models
from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.exports import ExportOptions
from gbspec.ir import Model
from gbspec.operations import exporting, models

SPAN, INTERVAL, LIMIT = 3.0, 0.5, 60


@dataclass(frozen=True)
class Outcome:
    """The errors of both round trips, or why there is none."""

    model: str
    sbml: str
    petab: str


def judged(name: str, path: Path) -> Outcome:
    """One model: at its truth, else with random weights, which PEtab problems leave out here."""
    loaded = gbspec.load(path)
    if not loaded.model.has_truth:
        subject = models.Subject(loaded.model, Evaluator(load_module(loaded.model).random(1)))
        return Outcome(f"{name} (random weights)", _exported(subject, "sbml", None), "")
    subject = models.reference(loaded.model)
    try:
        table = measured(loaded, loaded.model)
    except (UserError, ComputationError, ValueError) as problem:
        return Outcome(name, _exported(subject, "sbml", None), f"no table: {problem}"[:100])
    return Outcome(name, _exported(subject, "sbml", None), _exported(subject, "petab", table))


def measured(loaded: gbspec.api.Specification, model: Model) -> Trajectories:
    """Simulated rows, with a standard deviation of a twentieth of the largest value where no noise is stated."""
    doses = {dose.state: "1@0.25" for dose in model.doses}
    table = loaded.simulate(trajectories=2, span=SPAN, dt=INTERVAL, seed=1, dose=doses)
    items = []
    for item in table.items:
        size = np.nanmax(np.abs(item.values), axis=0, initial=1e-9)
        sd = np.where(np.isfinite(item.values), 0.05 * size, np.nan)
        stated = [channel.noise is not None for channel in model.channels]
        sd[:, stated] = np.nan
        items.append(replace(item, sd=sd))
    return replace(table, items=tuple(items))


def _exported(subject: models.Subject, form: str, data: Trajectories | None) -> str:
    findings = Findings()
    with tempfile.TemporaryDirectory() as place:
        target = Path(place) / ("model.xml" if form == "sbml" else "problem")
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        try:
            made = exporting.export(subject, target, form, ExportOptions(data=data), findings)
        except _LateError:
            return f"not compared within {LIMIT} s of processor time"
        except (UserError, ComputationError) as problem:
            said = problem.diagnostics[0].message if isinstance(problem, UserError) else str(problem)
            return said.partition(": ")[2] or said
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
    if made.checked:
        return f"{max(made.checked.values()):.1e}"
    return next(one.message for one in findings if one.code == "GB892").partition("again: ")[2]


def page(outcomes: list[Outcome]) -> str:
    """The table."""
    lines = [
        "# Round trips by SBML and PEtab",
        "",
        "Bundled models were exported (`gbspec export MODEL --as sbml`, `--as petab --data TABLE`), imported again",
        "(`gbspec import`) and compared: the rates of its states at random points, relative to their sizes, and the",
        "negative log likelihood (`gbspec evaluate`) of two simulated trajectories, relative to its size.",
        "Documents are consistent as libsbml judges. Otherwise the reason of the refusal:",
        "",
        "    python -m benchmarks.studies.exchange -o docs/studies/exchange.md",
        "",
        "| model | SBML, rates | PEtab, likelihood |",
        "|---|---|---|",
        *(f"| {one.model} | {one.sbml} | {one.petab} |" for one in outcomes),
    ]
    return "\n".join(lines) + "\n"


class _LateError(BaseException):
    """The time of one round trip is over; nothing else catches it."""


def _late(*given: object) -> None:
    raise _LateError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", dest="out", type=Path)
    given = parser.parse_args()
    outcomes = []
    signal.signal(signal.SIGPROF, _late)
    for name, path in sorted(shipped_models().items()):
        outcomes.append(judged(name, Path(path)))
        print(outcomes[-1], flush=True)
        if given.out is not None:
            given.out.write_text(page(outcomes), encoding="utf-8")


if __name__ == "__main__":
    main()
