"""Run directories that were changed: every command ends with a result or a diagnostic, never as a defect of gbspec.

A campaign: `python -m tests.tampering --count 1000`; a short one runs in tests/runs/test_tampering.py. A number always
gives the same change. After half of the changes the digests in `fit.json` are made right again, so that what is behind
them is reached. What fails is printed with its number, the command and the traceback's last line.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

DEFECT = 70
MODEL = (
    "model decay\nstate x in [0, 1]\nlearn k = 1 in [0, 5]\nlearn b = 0.1 in [0, 1]\nunknown g(x) by mlp(3)\n"
    "x' = -k*x + 0.1*g + b\nobserve x\n"
)
FIGURES = ("fit", "history", "constants", "functions", "residuals", "summary")
COMMANDS = (
    ("validate", "run"),
    ("validate", "run", "data.csv"),
    ("predict", "run", "data.csv", "-o", "p.csv"),
    ("report", "run", "-o", "r.html"),
    *(("plot", "run", kind, "-o", "f.svg") for kind in FIGURES),
    ("compile", "run", "-o", "m.py"),
    ("compile", "run", "--emit", "c", "-o", "m.c"),
    ("profile", "run", "k", "--points", "1", "--iterations", "2"),
    ("eigen", "run", "--steady"),
    ("simulate", "run", "-o", "s.csv", "--trajectories", "2"),
    ("train", "model.gb", "data.csv", "-o", "run", "--resume", *["--members", "2", "--method", "lm", "--epochs", "2"],
     *["--no-warm-start", "--workers", "1", "--threads", "1"]),
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 7, 2**63, 2**70, -(2**65), 1.5, 1e308, 5e-324, -1e300),
    *("", "x", "NaN", "²", "\0", "../..", "x" * 300, "0", "\u2028"),
    *([], [[]], [None], ["x"], [1, 2], {}, {"": 0}, {"x": {}}, {"x": None}, {"0": [1]}),
)


# ------------------------------------------------------------------------------------------------------------- changes
def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all parts of a JSON value."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(p for key, item in entries for p in places(item, (*path, key)))]


def other_value(run: Path, chance: random.Random) -> None:
    document = json.loads((run / "fit.json").read_text())
    for _ in range(chance.choice((1, 1, 1, 3))):
        path = chance.choice(places(document)[1:] or [()])
        if path:
            parent = document
            for key in path[:-1]:
                parent = parent[key]
            action = chance.random()
            if action < 0.7:
                parent[path[-1]] = chance.choice(VALUES)
            elif action < 0.85:
                del parent[path[-1]]
            elif isinstance(parent, list):
                parent.append(parent[path[-1]])
            else:
                parent[chance.choice(("x", "", "k", "²"))] = parent[path[-1]]
    (run / "fit.json").write_text(json.dumps(document))


def anything(run: Path, chance: random.Random) -> Path:
    """A file of the run; those of members are as likely as the others."""
    return chance.choice(sorted(p for p in run.rglob("*") if p.is_file() and p.name != ".lock"))


def truncate(run: Path, chance: random.Random) -> None:
    path = anything(run, chance)
    content = path.read_bytes()
    path.write_bytes(content[: chance.randrange(len(content) + 1)])


def flip(run: Path, chance: random.Random) -> None:
    path = anything(run, chance)
    content = bytearray(path.read_bytes())
    for _ in range(chance.choice((1, 1, 5))):
        if content:
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    path.write_bytes(content)


def replace(run: Path, chance: random.Random) -> None:
    content = chance.choice((b"", b"\0" * 50, b"{}", b"[]", b"null", b"\xff\xfe", b"a,b\n1,2\n", os.urandom(200)))
    anything(run, chance).write_bytes(content)


def remove(run: Path, chance: random.Random) -> None:
    chosen = chance.choice(sorted(p for p in run.rglob("*") if p.name != ".lock"))
    shutil.rmtree(chosen) if chosen.is_dir() else chosen.unlink()


def swap(run: Path, chance: random.Random) -> None:
    a, b = anything(run, chance), anything(run, chance)
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second), b.write_bytes(first)


def folder(run: Path, chance: random.Random) -> None:
    """A folder or a file of another name, or of the other kind."""
    members = run / "members"
    names = ("²", "-1", "007", "1e3", "٣", "99999999999999999999", " 1", "0.5", "x")
    match chance.randrange(4):
        case 0:
            shutil.copytree(members / "0", members / chance.choice(names))
        case 1:
            (members / "0").rename(members / chance.choice(names))
        case 2:
            shutil.rmtree(members)
            members.write_text("")
        case _:
            path = anything(run, chance)
            path.unlink()
            path.mkdir()


def tensors(run: Path, chance: random.Random) -> None:
    """Arrays that are missing, of another shape or not finite, in a file that is otherwise right."""
    from gbspec.runs import files

    path = chance.choice(sorted(run.rglob("*.safetensors")))
    arrays, remarks = files.read_tensors(path)
    name = chance.choice(sorted(arrays))
    match chance.randrange(5):
        case 0:
            del arrays[name]
        case 1:
            arrays[name] = np.zeros((2, 3))
        case 2:
            arrays[name] = np.full_like(arrays[name], chance.choice((np.nan, np.inf, 1e308, 5e-324)))
        case 3:
            arrays[name] = arrays[name].astype(np.int8)
        case _:
            keys = sorted(remarks) or ["x"]
            remarks[chance.choice(keys)] = chance.choice(VALUES)
    if "weights" in path.name:  # written by the module: other metadata
        from safetensors import safe_open
        from safetensors.numpy import save_file

        with safe_open(path, "np") as file:
            metadata = dict(file.metadata())
        info = json.loads(metadata["info"])
        if chance.random() < 0.7:
            info.pop("sha256")
        if chance.random() < 0.5:
            info[chance.choice(sorted(info))] = chance.choice(VALUES)
        save_file(arrays, path, metadata | {"info": json.dumps(info)})
    else:
        files.write_tensors(path, arrays, remarks)


CHANGES: tuple[Callable[[Path, random.Random], None], ...] = (
    *(other_value,) * 5, truncate, flip, flip, replace, remove, swap, folder, tensors, tensors, tensors,
)  # fmt: skip


def resealed(run: Path) -> None:
    """Makes the digests in `fit.json` those of the files that are there, as far as it is still such a document."""
    from gbspec.runs import files

    try:
        document = json.loads((run / "fit.json").read_text())
        for name in document["files"]:
            document["files"][name] = files.digest(run / name)
        for entry in document["members"]:
            for name in entry["files"]:
                entry["files"][name] = files.digest(run / "members" / str(entry["member"]) / name)
        (run / "fit.json").write_text(json.dumps(document))
    except (OSError, ValueError, KeyError, TypeError):
        return


# ----------------------------------------------------------------------------------------------------------- campaign
def make(place: Path) -> None:
    """A small run of two members beside its model and its table."""
    rows = [f"{n},{t / 8},{np.exp(-r * t / 8)}" for n, r in (("a", 2.0), ("b", 2.2)) for t in range(7)]
    (place / "data.csv").write_text("trajectory,t,x\n" + "\n".join(rows) + "\n")
    (place / "model.gb").write_text(MODEL)
    status, _, said = called(("train", *COMMANDS[-1][1:5], *COMMANDS[-1][6:]), place)
    assert status == 0, said


def called(arguments: tuple[str, ...], place: Path) -> tuple[int, str, str]:
    """Status, output and errors of a command in a directory."""
    import contextlib
    import io

    from gbspec.cli.app import build

    out, err, before = io.StringIO(), io.StringIO(), Path.cwd()
    os.chdir(place)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            build([arguments[0]])(args=[*arguments], prog_name="gbspec")
        status: object = 0
    except SystemExit as leave:
        status = leave.code or 0
    finally:
        os.chdir(before)
    return int(str(status)), out.getvalue(), err.getvalue()


def one(original: Path, number: int, commands: int = 1) -> list[tuple[tuple[str, ...], int, str]]:
    """The change of a number, and what commands make of it."""
    chance = random.Random(number)
    with tempfile.TemporaryDirectory() as folder_of_copy:
        place = Path(folder_of_copy) / "place"
        shutil.copytree(original, place)
        change = chance.choice(CHANGES)
        change(place / "run", chance)
        if chance.random() < 0.5:
            resealed(place / "run")
        found = []
        for arguments in chance.sample(COMMANDS, commands):
            status, _, said = called(arguments, place)
            found.append(((change.__name__, *arguments), status, said))
        return found


def main() -> int:
    """Runs a campaign from the command line; status 1 if a command ended as a defect."""
    parser = argparse.ArgumentParser(description="Commands on run directories that were changed.")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--commands", type=int, default=3, help="commands tried on each")
    options = parser.parse_args()
    os.environ["GBSPEC_TRACEBACK"] = "1"
    counts: Counter[int] = Counter()
    with tempfile.TemporaryDirectory() as folder_of_original:
        original = Path(folder_of_original)
        make(original)
        for number in range(options.first, options.first + options.count):
            for arguments, status, said in one(original, number, options.commands):
                counts[status] += 1
                if status not in (0, 1, 2, 3):
                    print(number, " ".join(arguments), status, *said.strip().splitlines()[-6:], sep="\n  ", flush=True)
    print(f"{options.count} changed runs; commands by status: {dict(sorted(counts.items()))}")
    return int(any(status not in (0, 1, 2, 3) for status in counts))


if __name__ == "__main__":
    sys.exit(main())
