"""One exact run of two tanks, of which the upper level is never measured and both outflows are unknown.

    python -m benchmarks.studies.two_tanks CASES -o two_tanks --seeds 10
    python -m benchmarks.studies.two_tanks CASES -o two_tanks --table docs/studies/two_tanks.md

CASES is a folder with `two_tanks.gb` and `two_tanks_input.csv`: 1,000 even rows are simulated with these inputs, and
fitted with all defaults and one seed after the other, which draws the initial weights. `r2`: R² of whole solutions;
`k`: the learned constant, and its relative error. A row is added to OUT/sets.csv as soon as its fit is done; the same
command run again continues with the missing fits.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from .sets import Key, Row, Study

FIELDS = ("cases", "seed", "r2", "naive", "k", "error", "warnings", "seconds")
NAME, K = "two_tanks", 0.06
"""The case, and the truth of its constant."""


def one_fit(cases: str, seed: int) -> list[Row]:
    """Simulates the run and fits it."""
    import gbspec

    model = gbspec.load(Path(cases) / f"{NAME}.gb")
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        model.simulate(place / "data.csv", like=Path(cases) / f"{NAME}_input.csv")
        began = time.process_time()
        fit = model.train(place / "data.csv", place / "run", threads=1, seed=seed).run.fit
        seconds = time.process_time() - began
        (member,) = fit.members
        assert member.channels is not None, "the fit has ended"
        whole, k = member.channels["h2"], fit.constants["k"].value
        assert whole.r2 is not None and whole.naive is not None, "the level varies"
    values = (cases, seed, whole.r2, whole.naive, k, abs(k / K - 1), len(fit.warnings), round(seconds))
    return [dict(zip(FIELDS, values, strict=True))]


def key_of(row: Row) -> Key:
    """The key of a row."""
    return str(row["cases"]), int(row["seed"])


def table(rows: Sequence[Row]) -> str:
    """The table in Markdown: a line for each seed."""
    lines = [
        "1,000 even rows without noise, the upper level hidden, both outflows unknown: defaults, one member.",
        "",
        "| seed | R² of whole solutions | naive R² | k | relative error | warnings | CPU s |",
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        r2, naive, k, error = (float(row[name]) for name in ("r2", "naive", "k", "error"))
        rest = f"{row['warnings']} | {row['seconds']}"
        lines.append(f"| {row['seed']} | {r2:.9f} | {naive:.3f} | {k:.6f} | {error:.1e} | {rest} |")
    return "\n".join(lines) + "\n"


def _wanted(chosen: argparse.Namespace) -> Iterable[Key]:
    return [(str(chosen.cases), seed) for seed in range(chosen.seeds)]


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("cases", type=Path)
    parser.add_argument("--seeds", type=int, default=10)


STUDY = Study(NAME, __doc__, FIELDS, one_fit, key_of, _wanted, table, _options)

if __name__ == "__main__":
    STUDY.run()
