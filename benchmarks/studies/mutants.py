"""Mutation campaign: small defects are put into the sources one at a time, and the tests that run them must fail.

    python -m pytest -n 2 --cov=gbspec --cov-context=test --cov-report= --durations=0 tests > durations.log
    python -m benchmarks.studies.mutants -o mutants --coverage .coverage --durations durations.log --count 300
    python -m benchmarks.studies.mutants -o mutants --again tests/contracts,tests/api,tests/cli
    python -m benchmarks.studies.mutants -o mutants --table docs/studies/mutants.md

Mutants are drawn at random, with a seed, as many of the functions of each of `ROOMS`: operators (`+`, `*`, `<`, `and`,
...), numbers, `min` for `max`, negated conditions, and two exchanged arguments. Messages and declarations are left
alone. The tests whose coverage contains the mutated line are run in a copy of the tree, fastest first, within
`--seconds` of processor time; a mutant that one of them notices, or that does not end, is killed. A row is added to
OUT/mutants.csv as soon as a mutant is judged; the same command run again continues. `equivalent` marks survivors that a
reader found to change no result: they are listed by file and change in `mutants_equivalent.toml`, each with the reason.
`--again` judges those that survived once more, by the tests that it names: new ones, or those of other packages.
"""

from __future__ import annotations

import argparse
import ast
import copy
import csv
import importlib
import os
import random
import re
import shutil
import signal
import sqlite3
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import accumulate, zip_longest
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = ("ir", "lower", "passes", "training", "analysis", "backends", "data")
FIELDS = ("file", "line", "change", "result", "tests", "by")
BINARY: Mapping[type[ast.AST], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.FloorDiv, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
COMPARED: Mapping[type[ast.AST], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
CALLED = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum",
          "argmin": "argmax", "argmax": "argmin", "floor": "ceil", "ceil": "floor"}  # fmt: skip
CHANGED = (ast.BinOp, ast.AugAssign, ast.Compare, ast.BoolOp, ast.UnaryOp, ast.Constant, ast.If, ast.IfExp, ast.While,
           ast.Call)  # fmt: skip
SPOKEN = ("Diagnostic", "UserError", "ComputationError", "warn", "message")
"""Calls whose arguments are words for the user: their numbers and operators are not mutated."""
HEAD = """# Mutants

`python -m benchmarks.studies.mutants` puts small defects into the sources, one at a time; the tests must fail. The
text at the head of the module has the commands, [reliability](../reliability.md) the conditions. Survivors were read:
where a mutant changes a result, a test was written that kills it, so that the shares are those of the tests after the
campaign, for the mutants of the campaign.

"""
Row = dict[str, str]


@dataclass(frozen=True)
class Mutant:
    """A change of a file: the number of its place among the file's places, its line, and what it does.

    `lines` are the first and the last line of its statement (of the head, where it has a body): a test that runs one of
    them sees the change, also where coverage attributes an expression to another line than it stands in.
    """

    file: str
    place: int
    line: int
    change: str
    lines: tuple[int, int]


class _Mutator(ast.NodeVisitor):
    """Counts the places where a function's code can be changed, and keeps the change of number `wanted`."""

    def __init__(self, wanted: int = -1) -> None:
        self.wanted, self.depth, self.found = wanted, 0, list[tuple[int, str, tuple[int, int]]]()
        self.lines = (0, 0)
        self.change: tuple[ast.AST, ast.AST] | None = None

    def generic_visit(self, node: ast.AST) -> None:
        outer = self.lines
        if isinstance(node, ast.stmt):
            self.lines = _head(node)
        self._visit(node)
        self.lines = outer

    def _visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.FunctionDef):
            self.depth += 1
            for one in node.body:
                self.visit(one)
            self.depth -= 1
            return
        if isinstance(node, ast.AnnAssign | ast.Raise | ast.Assert | ast.JoinedStr | ast.Global | ast.ImportFrom):
            return
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in SPOKEN:
            return
        for new, what in _changes(node) if self.depth else ():
            if len(self.found) == self.wanted:
                self.change = node, new
            self.found.append((getattr(node, "lineno", 0), what, self.lines))
        super().generic_visit(node)


def _head(node: ast.stmt) -> tuple[int, int]:
    """The first and the last line of a statement without its body."""
    body = [case.pattern for case in node.cases] if isinstance(node, ast.Match) else getattr(node, "body", None)
    last = body[0].lineno - 1 if body else node.end_lineno or node.lineno
    return node.lineno, max(node.lineno, last)


def _changes(node: ast.AST) -> Iterator[tuple[ast.AST, str]]:
    """What a node can be changed to, with words."""
    if not isinstance(node, CHANGED):
        return
    new = copy.copy(node)  # what it shares with the node stays as it is
    if isinstance(new, ast.BinOp | ast.AugAssign) and type(new.op) in BINARY:
        new.op = BINARY[type(new.op)]()
    elif isinstance(new, ast.Compare) and len(new.ops) == 1 and type(new.ops[0]) in COMPARED:
        new.ops = [COMPARED[type(new.ops[0])]()]
    elif isinstance(new, ast.BoolOp):
        new.op = ast.And() if isinstance(new.op, ast.Or) else ast.Or()
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, ast.Not | ast.USub):
        yield new.operand, f"{ast.unparse(node)} -> {ast.unparse(new.operand)}"
        return
    elif isinstance(new, ast.Constant) and isinstance(new.value, bool | int | float):
        new.value = not new.value if isinstance(new.value, bool) else new.value + 1
    elif isinstance(new, ast.If | ast.IfExp | ast.While):
        new.test = ast.UnaryOp(ast.Not(), new.test)
        yield new, f"if {ast.unparse(getattr(node, 'test', node))} -> if not ..."
        return
    elif isinstance(new, ast.Call) and _name(new.func) in CALLED:
        name = CALLED[_name(new.func)]
        if isinstance(new.func, ast.Attribute):
            new.func = copy.copy(new.func)
            new.func.attr = name
        else:
            new.func = ast.Name(name)
    elif isinstance(new, ast.Call) and len(new.args) == 2 and all(isinstance(one, ast.Name) for one in new.args):
        new.args = [new.args[1], new.args[0]]
    else:
        return
    yield new, f"{ast.unparse(node)} -> {ast.unparse(ast.fix_missing_locations(new))}"


def _name(function: ast.expr) -> str:
    return function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")


@cache
def mutants_of(path: Path) -> list[Mutant]:
    """All mutants of a file."""
    mutator = _Mutator()
    mutator.visit(ast.parse(path.read_text(encoding="utf-8")))
    file = str(path.relative_to(ROOT))
    return [Mutant(file, place, line, what, lines) for place, (line, what, lines) in enumerate(mutator.found)]


def mutated(mutant: Mutant, source: str) -> str:
    """The source with the change; everything else, comments too, stays as it is."""
    mutator = _Mutator(mutant.place)
    mutator.visit(ast.parse(source))
    assert mutator.change is not None
    old, new = mutator.change
    if isinstance(old, ast.If | ast.IfExp | ast.While) and isinstance(new, ast.If | ast.IfExp | ast.While):
        old, new = old.test, new.test
    assert isinstance(old, ast.expr | ast.AugAssign)
    text = ast.unparse(ast.fix_missing_locations(new))
    text = f"({text})" if isinstance(old, ast.expr) else text
    lines = source.encode().splitlines(keepends=True)
    starts = [0, *accumulate(map(len, lines))]
    begin = starts[old.lineno - 1] + old.col_offset
    end = starts[(old.end_lineno or old.lineno) - 1] + (old.end_col_offset or 0)
    return (source.encode()[:begin] + text.encode() + source.encode()[end:]).decode()


def drawn(count: int, seed: int) -> list[Mutant]:
    """Random mutants, as many of each package, without repetition; one of each package after the other."""
    chance = random.Random(seed)
    share = -(-count // len(ROOMS))
    draws = []
    for room in ROOMS:
        every = [one for path in sorted((ROOT / "gbspec" / room).rglob("*.py")) for one in mutants_of(path)]
        draws.append(chance.sample(every, min(share, len(every))))
    return [one for turn in zip_longest(*draws) for one in turn if one is not None]


@dataclass(frozen=True)
class Judge:
    """Runs the tests of mutants in copies of the tree."""

    coverage: Path
    durations: Mapping[str, float]
    seconds: float

    def tests(self, mutant: Mutant) -> list[str]:
        """The tests that run the mutated statement, fastest first, as many as fit into the time."""
        with sqlite3.connect(self.coverage) as database:
            query = (
                "select context.context, line_bits.numbits from line_bits join file on file.id = line_bits.file_id "
                "join context on context.id = line_bits.context_id where file.path like ?"
            )
            found = database.execute(query, (f"%/{mutant.file}",)).fetchall()
        first, last = mutant.lines
        seen = {context for context, bits in found if any(_has(bits, n) for n in range(first, last + 1))}
        names = {context.rpartition("|")[0] for context in seen if context}
        ordered = sorted(names, key=lambda name: (self.durations.get(name, 0.0), name))
        return self._within(ordered)

    def fallback(self, mutant: Mutant) -> list[str]:
        """The tests of the mutant's package, where coverage names none."""
        room = f"tests/{Path(mutant.file).parts[1]}/"
        return self._within(sorted((n for n in self.durations if n.startswith(room)), key=self.durations.__getitem__))

    def _within(self, ordered: Sequence[str]) -> list[str]:
        """The first tests, as many as fit into the time."""
        spent, chosen = 0.0, list[str]()
        for name in ordered:
            spent += self.durations.get(name, 0.0) + 0.02
            if chosen and spent > self.seconds:
                break
            chosen.append(name)
        return chosen

    def judge(self, mutant: Mutant, place: Path) -> Row:
        """The row of a mutant, judged in the copy of the tree at `place`."""
        tests = self.tests(mutant)
        row = {"file": mutant.file, "line": str(mutant.line), "change": mutant.change, "tests": str(len(tests))}
        if not tests:  # the sources of generated code are run under other names
            tests = self.fallback(mutant)
        if not tests:
            return row | {"result": "not run", "by": ""}
        return row | self.by_tests(mutant, tests, place)

    def by_tests(self, mutant: Mutant, tests: Sequence[str], place: Path) -> Row:
        """The result of a mutant by the given tests."""
        path, original = place / mutant.file, (ROOT / mutant.file).read_text(encoding="utf-8")
        path.write_text(mutated(mutant, original), encoding="utf-8")
        try:
            return self._verdict(tests, place)
        finally:
            path.write_text(original, encoding="utf-8")

    def _verdict(self, tests: Sequence[str], place: Path) -> Row:
        log = place.with_suffix(".log")
        process = _started([*("-x", "-q", "-p", "no:cacheprovider", "--no-header"), *tests], place, log)
        status = _awaited(process, 60 + 10 * self.seconds)
        if status is None:
            return {"result": "killed", "by": "did not end"}
        by = re.search(r"^(?:FAILED|ERROR) (\S+)", log.read_text(encoding="utf-8", errors="replace"), re.MULTILINE)
        return {"result": "killed" if status else "survived", "by": by.group(1) if by else ""}


def _has(bits: bytes, line: int) -> bool:
    """Whether a set of lines has one, as coverage stores it: a bit for each."""
    return line // 8 < len(bits) and bool(bits[line // 8] >> line % 8 & 1)


def _started(arguments: Sequence[str], place: Path, log: Path) -> int:
    """A forked process that runs pytest in a copy of the tree: it has the large libraries that this one imported."""
    process = os.fork()
    if process:
        return process
    status = 1
    try:
        os.setpgid(0, 0)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(output, stream)
        os.chdir(place)
        os.environ.update({"PYTHONPATH": str(place), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"})
        sys.dont_write_bytecode = True
        sys.path[:] = [str(place), *(one for one in sys.path if Path(one or ".").resolve() != ROOT)]
        for name in [name for name in sys.modules if name.partition(".")[0] == "benchmarks"]:
            del sys.modules[name]
        import pytest

        status = int(pytest.main(["--rootdir", str(place), "-c", str(place / "pyproject.toml"), *arguments]))
    finally:
        sys.stdout.flush()
        os._exit(status)


def _awaited(process: int, seconds: float) -> int | None:
    """The exit status of a process; None where it did not end in time, and was killed with those that it started."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.1)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None


def prepare() -> None:
    """Imports what the tests would import in each process again."""
    for name in ("numpy", "scipy.optimize", "sympy", "torch", "casadi", "polars", "pyarrow", "hypothesis", "pytest"):
        importlib.import_module(name)


def durations(path: Path) -> dict[str, float]:
    """The seconds of each test, from a log of pytest with `--durations=0`."""
    found = re.findall(r"^\s*([\d.]+)s (?:call|setup)\s+(\S.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    total: dict[str, float] = {}
    for seconds, name in found:
        total[name.strip()] = total.get(name.strip(), 0.0) + float(seconds)
    return total


def copied(place: Path) -> Path:
    """A copy of the tree in which mutants are tested."""

    def left(folder: str, names: list[str]) -> set[str]:
        top = {".git", ".venv", "runs", "demo"} if Path(folder) == ROOT else set[str]()
        return {name for name in names if name in top | {"__pycache__"} or name.endswith("_cache")}

    if not place.is_dir():
        shutil.copytree(ROOT, place, ignore=left, symlinks=True)
    return place


def equivalent() -> dict[str, str]:
    """Why survivors change no result, by `file: change`."""
    path = Path(__file__).with_name("mutants_equivalent.toml")
    return dict(tomllib.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


def table(rows: Sequence[Row]) -> str:
    """The summary in Markdown: a line for each room, and the survivors."""
    same = equivalent()
    lines = [*HEAD.splitlines(),
             "| package | mutants | killed | equivalent | survived | not run | killed, of those not equivalent |",
             "|---|---:|---:|---:|---:|---:|---:|"]  # fmt: skip
    for room in (*ROOMS, "all"):
        own = [row for row in rows if room == "all" or row["file"].startswith(f"gbspec/{room}/")]
        killed = sum(row["result"] == "killed" for row in own)
        alike = sum(row["result"] == "survived" and _label(row) in same for row in own)
        idle = sum(row["result"] == "not run" for row in own)
        rest = max(len(own) - alike, 1)
        lines.append(f"| {room} | {len(own)} | {killed} | {alike} | {len(own) - killed - alike - idle} | {idle} | "
                     f"{100 * killed / rest:.0f} % |")  # fmt: skip
    left = [row for row in rows if row["result"] != "killed"]
    lines += ["", "Not killed:", ""]
    lines += [
        f"- `{row['file']}:{row['line']}`: `{row['change']}` ({same.get(_label(row), row['result'])})" for row in left
    ]
    return "\n".join(lines) + "\n"


def _label(row: Row) -> str:
    return f"{row['file']}: {row['change']}"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies.mutants", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, default=Path("mutants"))
    parser.add_argument("--coverage", type=Path, default=Path(".coverage"))
    parser.add_argument("--durations", type=Path, default=Path("durations.log"))
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=40.0, help="of tests for a mutant, as they last without it")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--again", default="", help="judge survivors again, by these tests (commas between them)")
    parser.add_argument("--rooms", default=",".join(ROOMS), help="judge the drawn mutants of these packages alone")
    parser.add_argument("--table", type=Path, help="write the table of the judged mutants, without running tests")
    chosen = parser.parse_args()
    chosen.output.mkdir(parents=True, exist_ok=True)
    path = chosen.output / "mutants.csv"
    if chosen.again:
        prepare()
        _again(Judge(chosen.coverage, {}, chosen.seconds), path, chosen.again.split(","))
    elif chosen.table is None:
        judge = Judge(chosen.coverage.resolve(), durations(chosen.durations), chosen.seconds)
        done = {(row["file"], row["line"], row["change"]) for row in _read(path)}
        rooms = chosen.rooms.split(",")
        new = [m for m in drawn(chosen.count, chosen.seed) if (m.file, str(m.line), m.change) not in done]
        waiting = [m for m in new if Path(m.file).parts[1] in rooms]
        prepare()
        _campaign(judge, waiting, path, chosen.workers)
    rows = _read(path)
    print(table(rows))
    if chosen.table is not None:
        chosen.table.write_text(table(rows), encoding="utf-8")


def _campaign(judge: Judge, waiting: Sequence[Mutant], path: Path, workers: int) -> None:
    places = [copied(path.parent.resolve() / f"tree{i}") for i in range(workers)]

    def work(i: int) -> None:
        for mutant in waiting[i::workers]:
            _append(path, judge.judge(mutant, places[i]))

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, range(workers)))


def _again(judge: Judge, path: Path, tests: Sequence[str]) -> None:
    """Judges survivors by other tests, in a new copy of the tree, and replaces their rows."""
    place = path.parent.resolve() / "again"
    shutil.rmtree(place, ignore_errors=True)
    copied(place)
    for row in _read(path):
        if row["result"] == "killed" or _label(row) in equivalent():
            continue
        key = (row["line"], row["change"])
        found = [one for one in mutants_of(ROOT / row["file"]) if (str(one.line), one.change) == key]
        verdict = row | judge.by_tests(found[0], tests, place)
        rows = [verdict if old == row else old for old in _read(path)]
        path.unlink()
        for one in rows:
            _append(path, one)


def _append(path: Path, row: Row) -> None:
    new = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, FIELDS)
        if new:
            writer.writeheader()
        writer.writerow(row)


def _read(path: Path) -> list[Row]:
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


if __name__ == "__main__":
    main()
