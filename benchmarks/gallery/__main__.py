"""Executes the cases of the gallery and writes its page.

    python -m benchmarks.gallery [--data FOLDER] [--only reactor,river]

A case is executed in a folder of its own: its commands, of which the last draws the figure, then `gbspec validate`.
What was measured is kept in docs/gallery/measured.json and the figures in docs/gallery/; docs/gallery.md is written
from these and from cases.toml. FOLDER has the published tables (docs/data_sources.md says where to get them); cases
whose table is not there keep what was measured before. `--only` executes some of the cases, `--only ''` none.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.gallery.page import Case, cases, page

DOCS = Path(__file__).resolve().parents[2] / "docs"
LARGEST = 60_000
"""Bytes of a figure."""


def executed(case: Case, data: Path | None) -> dict[str, Any] | None:
    """What was measured in executing a case; None where its table is not there. The figure goes to docs/gallery."""
    if case.table and (data is None or not (data / case.table).is_file()):
        return None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if case.table and data is not None:
            shutil.copy(data / case.table, folder)
        if case.file:
            (folder / case.file).write_text(case.source.lstrip(), encoding="utf-8")
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        for command in case.commands:
            ran(command, folder)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        small(folder / case.figure, DOCS / "gallery" / case.figure)
        report = json.loads(ran("gbspec validate run --json", folder))
        fit = json.loads((folder / "run" / "fit.json").read_text(encoding="utf-8"))
    return {"cpu": round(cpu, 1), "wall": round(time.perf_counter() - began, 1), **measured(case, report, fit)}


def ran(command: str, folder: Path) -> str:
    """The standard output of a command, by the interpreter's own gbspec."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", "-c", command], cwd=folder, env={**os.environ, "PATH": path}, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"{command}\n{done.stdout}{done.stderr}")
    return done.stdout


def measured(case: Case, report: Mapping[str, Any], fit: Mapping[str, Any]) -> dict[str, Any]:
    """What the page says of a run, from `validate --json` and fit.json."""
    truth = report.get("truth") or {}
    channels = report["channels"]
    found: dict[str, Any] = {
        "values": fit["data"]["values"],
        "trajectories": fit["data"]["trajectories"],
        "r2": {name: one["r2"] for name, one in channels.items()},
        "constants": {
            name: {"value": one["value"], "interval": one["interval"]} for name, one in fit["constants"].items()
        },
        "functions": {name: one["L2"] for name, one in truth.get("functions", {}).items() if name != "all"},
        "true": truth.get("constants", {}),
    }
    if case.squares:
        found["squares"] = sum(one["n"] * one["rmse"] ** 2 for one in channels.values())
    return found


def small(source: Path, target: Path) -> None:
    """The figure with as many colours as fit into `LARGEST` bytes."""
    from PIL import Image

    target.parent.mkdir(exist_ok=True)
    with Image.open(source) as opened:
        image = opened.convert("RGB")
    for colours, width in ((64, 1056), (32, 1056), (32, 800), (16, 700)):
        if image.width > width:
            image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
        image.quantize(colours).save(target, optimize=True)
        if target.stat().st_size <= LARGEST:
            return
    raise SystemExit(f"{target.name} has {target.stat().st_size} bytes")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gallery", description=__doc__)
    parser.add_argument("--data", type=Path, help="the folder with the published tables")
    parser.add_argument("--only", help="the cases to execute, separated by commas")
    chosen = parser.parse_args()
    store = DOCS / "gallery" / "measured.json"
    known: dict[str, Any] = json.loads(store.read_text(encoding="utf-8")) if store.is_file() else {}
    wanted = None if chosen.only is None else set(filter(None, chosen.only.split(",")))
    for name, case in cases().items():
        if wanted is not None and name not in wanted:
            continue
        found = executed(case, chosen.data)
        if found is None:
            print(f"{name}: its table {case.table} is not there", flush=True)
            continue
        known[name] = found
        store.parent.mkdir(exist_ok=True)
        store.write_text(
            json.dumps({key: known[key] for key in cases() if key in known}, indent=1) + "\n", encoding="utf-8"
        )
        print(f"{name}: {found['cpu']} s", flush=True)
        (DOCS / "gallery.md").write_text(page(known), encoding="utf-8")
    (DOCS / "gallery.md").write_text(page(known), encoding="utf-8")


if __name__ == "__main__":
    main()
