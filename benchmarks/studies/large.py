"""Large tables and long trajectories: processor time and memory of reading and of fitting one constant.

    python -m benchmarks.studies.large -o benchmarks/studies/large.csv
    python -m benchmarks.studies.large --only read-2-GB --folder /large/disk -o benchmarks/studies/large.csv

Each table is made in a temporary folder (below `--folder`) and deleted when it was measured. Reading is that of every
command, for a model of one state. The time is that of the processor (user and system), the memory the largest resident
set, of a process of its own. `python -m benchmarks.studies.limits` writes the rows of the CSV file into docs/limits.md;
rows of cases that are not chosen stay in it.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

RESULTS = Path(__file__).with_suffix(".csv")
FIELDS = ("case", "what", "megabytes", "rows", "seconds", "memory", "status")
MODEL = "model m\nstate x in [0, 2]\nlearn k = 0.5 in [0.1, 5]\nx' = -k*x + 0.5*sin(t)\nobserve x\n"
PART = 1_000_000
READ = """
import sys
from gbspec import frontend
from gbspec.diagnostics import Findings
from gbspec.operations import tables
findings = Findings()
data = tables.read_data(sys.argv[2], frontend.load_model(sys.argv[1], findings), findings)
assert data.measurements == int(sys.argv[3]), data.measurements
"""


@dataclass(frozen=True)
class Case:
    """A table of `rows` rows in trajectories of `length`, and what is done with it: Python's arguments."""

    what: str
    rows: int
    length: int
    call: Callable[[Path, Path, int], list[str]]


def reading(model: Path, table: Path, rows: int) -> list[str]:
    """Reading alone; every measured value must be there afterwards."""
    return ["-c", READ, str(model), str(table), str(rows)]


def fitting(model: Path, table: Path, rows: int) -> list[str]:
    """`gbspec train` with its defaults."""
    return ["-m", "gbspec", "train", str(model), str(table), "-o", str(table.with_suffix("")), "--members", "1"]


CASES = {
    "read-160-MB": Case("reading 5,000,000 rows in 1,000 trajectories", 5_000_000, 5_000, reading),
    "read-2-GB": Case("reading 62,000,000 rows in 1,000 trajectories", 62_000_000, 62_000, reading),
    "read-long": Case("reading one trajectory of 100,000 rows", 100_000, 100_000, reading),
    "train-long": Case("`train`: one trajectory of 100,000 rows", 100_000, 100_000, fitting),
}


def write(path: Path, rows: int, length: int) -> None:
    """A table of x' = -x + sin(t)/2 with noise, by rows 0.01 apart, in trajectories of `length`."""
    chance = np.random.default_rng(0)
    with path.open("wb") as file:
        for begin in range(0, rows, PART):
            number, row = np.divmod(np.arange(begin, min(begin + PART, rows)), length)
            t = np.round(0.01 * row, 2)
            x = 1.25 * np.exp(-t) + 0.25 * (np.sin(t) - np.cos(t)) + 0.01 * chance.standard_normal(len(t))
            part = pl.DataFrame({"trajectory": number, "t": t, "x": x})
            part.write_csv(file, include_header=begin == 0)


def measured(name: str, case: Case, folder: Path) -> dict[str, str]:
    """The row of a case."""
    with tempfile.TemporaryDirectory(dir=folder) as made:
        place = Path(made)
        (place / "m.gb").write_text(MODEL)
        write(place / "t.csv", case.rows, case.length)
        size = (place / "t.csv").stat().st_size
        with (place / "out").open("wb") as out:
            arguments = case.call(place / "m.gb", place / "t.csv", case.rows)
            process = subprocess.Popen([sys.executable, *arguments], stdout=out, stderr=out)
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            print((place / "out").read_text(errors="replace")[-2000:], file=sys.stderr)
    values = (name, case.what, f"{size / 1e6:.0f}", str(case.rows), f"{used.ru_utime + used.ru_stime:.1f}")
    return dict(zip(FIELDS, (*values, f"{used.ru_maxrss / 1024:.0f}", str(process.returncode)), strict=True))


def read(path: Path = RESULTS) -> dict[str, Mapping[str, str]]:
    """The measured rows, by the names of their cases."""
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8", newline="") as file:
        return {row["case"]: row for row in csv.DictReader(file)}


def table(rows: Mapping[str, Mapping[str, str]]) -> str:
    """The rows in Markdown."""
    lines = ["| | table, MB | processor time, s | memory, MB |", "|---|---:|---:|---:|"]
    lines += [
        f"| {row['what']} | {float(row['megabytes']):,.0f} | {row['seconds']} | {float(row['memory']):,.0f} |"
        for row in (rows[name] for name in CASES if name in rows)
    ]
    return "\n".join(lines)


def main() -> int:
    """Measures the chosen cases and writes their rows; status 1 if a command failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="names of cases, with commas between them")
    parser.add_argument("--folder", type=Path, help="where tables are made (default: that of temporary files)")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    failed = False
    for name, case in CASES.items():
        if options.only and name not in options.only.split(","):
            continue
        row = measured(name, case, options.folder)
        print(row, flush=True)
        failed |= row["status"] != "0"
        rows = {**read(options.output), name: row}
        with options.output.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows[known] for known in CASES if known in rows)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
