"""Fuzzing that is guided by coverage (libFuzzer through Atheris) of the parser, the table reader and the run loader.

    python -m tests.fuzz_guided parser corpus/parser -max_total_time=1800

Targets: `parser` (a text through the whole front end and the formatter), `table` (bytes as a CSV file), `parquet`
(bytes as a Parquet file), `record` (bytes as the fit.json of a run, opened and its members loaded), `weights` (bytes as
a weights file). Whatever raises anything but the errors that are told to users is a crash, written beside the corpus
as libFuzzer does. Atheris has wheels for Linux and macOS: `pip install atheris`.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

TARGETS = ("parser", "table", "parquet", "record", "weights")
TABLE_MODEL = (
    "model tabled\ntime t\nstate x in [0, 1]\nstate y\ncondition c in [0, 1] = 0.5\ninput u held\ndose x\n"
    "learn k = 1 in [0, 5]\nx' = -k*x + u\ny' = c - y\nobserve x\nobserve y\n"
)
LARGEST = 20_000
"""Bytes of an input."""
Target = Callable[[bytes], None]


def parser(_: Path) -> tuple[Target, list[bytes]]:
    """Texts: the front end must give a model or findings, and a model can be formatted."""
    from tests.fuzz import corpus, front_end

    def run(content: bytes) -> None:
        front_end(content.decode("utf-8", errors="replace"))

    return run, [text.encode() for text in corpus()]


def _tabled(place: Path, suffix: str) -> Target:
    from gbspec.data import read
    from gbspec.diagnostics import Findings, Severity, UserError
    from gbspec.frontend import load_model

    (place / "tabled.gb").write_text(TABLE_MODEL, encoding="utf-8")
    model = load_model(place / "tabled.gb", Findings())
    path = place / f"table{suffix}"

    def run(content: bytes) -> None:
        path.write_bytes(content)
        try:
            read(path, model, Findings())
        except UserError as error:
            assert any(each.severity is Severity.ERROR for each in error.diagnostics), "an error without a finding"

    return run


def table(place: Path) -> tuple[Target, list[bytes]]:
    """CSV files of a model with a condition, an input and a dose."""
    seeds = [
        "trajectory,t,x,y,c,u,d\na,0,1,,0.5,0,1\na,1,0.5,2,,1,\nb,0,0.1,1,0.2,0,\n",
        "t,x\n0,1\n1,2\n", "trajectory\tt\tx\ty\n1\t0\t1\t.\n1\t1\tNA\t3\n", "t;x;y\n0,5;1,0;2\n1,5;1;2\n",
        "trajectory,t,quantity,value,sd\na,0,x,1,0.1\na,0,y,2,\na,1,u,0.5,\n", '\ufefft,"x",sd_x\n"0","1",0.1\n',
    ]  # fmt: skip
    return _tabled(place, ".csv"), [seed.encode() for seed in seeds]


def parquet(place: Path) -> tuple[Target, list[bytes]]:
    """Parquet files of the same model."""
    import polars as pl

    frames = (
        pl.DataFrame({"trajectory": ["a", "a"], "t": [0.0, 1.0], "x": [1.0, None], "y": [2, 3]}),
        pl.DataFrame({"t": [0, 1], "x": [1.0, 2.0]}),
    )
    seeds = []
    for frame in frames:
        frame.write_parquet(place / "seed.parquet")
        seeds.append((place / "seed.parquet").read_bytes())
    return _tabled(place, ".parquet"), seeds


def _opened(place: Path, name: str) -> tuple[Target, list[bytes]]:
    from gbspec.diagnostics import UserError
    from gbspec.operations.models import open_run
    from tests.tampering import make, resealed

    make(place)
    path = next((place / "run").rglob(name))
    sound = path.read_bytes()

    def run(content: bytes) -> None:
        path.write_bytes(content)
        try:
            if name != "fit.json":
                resealed(place / "run")
            run = open_run(place / "run")
            for number in run.numbers:
                run.member(number)
        except UserError:
            return
        finally:
            (place / "run" / "fit.json").write_bytes(record)

    record = (place / "run" / "fit.json").read_bytes()
    return run, [sound]


def record(place: Path) -> tuple[Target, list[bytes]]:
    """The record of a run; its digests cover the other files, not itself."""
    run, seeds = _opened(place, "fit.json")
    return run, [*seeds, json.dumps(json.loads(seeds[0])).encode()]


def weights(place: Path) -> tuple[Target, list[bytes]]:
    """The weights of a member, with their digest in the record made right."""
    return _opened(place, "weights.safetensors")


ROOMS = ("diagnostics", "syntax", "semantics", "ir", "lower", "passes", "data", "runs")


def loaded() -> list[str]:
    """Imports every module that the targets may reach: packages load theirs when first used, which is too late."""
    names = ["gbspec.frontend", "gbspec.operations.models"]
    for room in ROOMS:
        package = importlib.import_module(f"gbspec.{room}")
        names += [each.name for each in pkgutil.walk_packages(package.__path__, f"gbspec.{room}.")]
    for name in names:
        importlib.import_module(name)
    return names


def main() -> int:
    """Runs one target; arguments after its name go to libFuzzer."""
    if len(sys.argv) < 3 or sys.argv[1] not in TARGETS:
        print(f"usage: python -m tests.fuzz_guided {{{','.join(TARGETS)}}} CORPUS [libFuzzer's options]")
        return 2
    try:
        import atheris
    except ImportError:
        print("Atheris is missing: pip install atheris")
        return 2
    name, corpus = sys.argv[1], Path(sys.argv[2])
    with atheris.instrument_imports(include=["gbspec"]):
        loaded()
    place = Path(tempfile.mkdtemp())
    try:
        run, seeds = globals()[name](place)
        corpus.mkdir(parents=True, exist_ok=True)
        for number, seed in enumerate(seeds):
            if len(seed) <= LARGEST:
                (corpus / f"seed{number}").write_bytes(seed)
        atheris.Setup([sys.argv[0], str(corpus), f"-max_len={LARGEST}", "-timeout=60", *sys.argv[3:]], run)
        atheris.Fuzz()
    finally:
        shutil.rmtree(place, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
