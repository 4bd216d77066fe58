"""Studies of many simulated sets: run side by side, a row to a file as each is done, continued where they stopped."""

from __future__ import annotations

import argparse
import csv
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

Row = dict[str, str | float | int]
Key = tuple[str | float | int, ...]


@dataclass(frozen=True)
class Study:
    """A study: `one` computes the rows of a set from its key, `key` is the key of a row, `table` the summary.

    `wanted` gives the keys of all sets, in the order in which they are computed, from the options of the command.
    """

    name: str
    description: str
    fields: Sequence[str]
    one: Callable[..., list[Row]]
    key: Callable[[Row], Key]
    wanted: Callable[[argparse.Namespace], Iterable[Key]]
    table: Callable[[Sequence[Row]], str]
    options: Callable[[argparse.ArgumentParser], object]

    def run(self) -> None:
        """The command: computes the missing sets, or with `--table` writes the summary of those that are there."""
        chosen = self._chosen()
        path = chosen.rows or chosen.output / "sets.csv"
        if chosen.table is None:
            os.environ.setdefault("OMP_NUM_THREADS", "1")
            path.parent.mkdir(parents=True, exist_ok=True)
            self._compute(path, chosen)
        rows = read(path)
        if not rows:
            raise SystemExit(f"{path}: no finished sets yet")
        order = {key: place for place, key in enumerate(self.wanted(chosen))}
        rows.sort(key=lambda row: order.get(self.key(row), len(order)))
        print(self.table(rows))
        if chosen.table is not None:
            chosen.table.write_text(self.table(rows), encoding="utf-8")

    def _chosen(self) -> argparse.Namespace:
        parser = argparse.ArgumentParser(
            prog=f"python -m benchmarks.studies.{self.name}",
            description=self.description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        parser.add_argument("-o", "--output", type=Path, default=Path(self.name))
        parser.add_argument("--rows", type=Path, help="the file of the rows (default: sets.csv in the output)")
        parser.add_argument("--workers", type=int, default=1)
        parser.add_argument("--table", type=Path, help="write the table of the finished sets, without fitting")
        self.options(parser)
        return parser.parse_args()

    def _compute(self, path: Path, chosen: argparse.Namespace) -> None:
        done = {self.key(row) for row in read(path)}
        missing = [key for key in self.wanted(chosen) if key not in done]
        failed = []
        with ProcessPoolExecutor(chosen.workers, mp_context=get_context("spawn")) as pool:
            futures = {pool.submit(self.one, *key): key for key in missing}
            for future in as_completed(futures):
                try:
                    self._append(path, future.result())
                except Exception:
                    failed.append(futures[future])
                    print(f"failed: {futures[future]}", traceback.format_exc(), sep="\n", file=sys.stderr, flush=True)
        if failed:
            raise SystemExit(f"{len(failed)} sets failed: {failed}")

    def _append(self, path: Path, rows: Sequence[Row]) -> None:
        new = not path.is_file()
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.fields)
            if new:
                writer.writeheader()
            writer.writerows(rows)


def read(path: Path) -> list[Row]:
    """The rows of the finished sets."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [dict(row) for row in csv.DictReader(file)]


def by_model(row: Row) -> Key:
    """The key of a row with a model, a noise and a seed."""
    return str(row["model"]), float(row["noise"]), int(row["seed"])
