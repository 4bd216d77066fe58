"""Oversized and hostile inputs: the processor time and the memory until gbspec refuses, or accepts, each of them.

    python -m benchmarks.studies.limits -o docs/limits.md
    python -m benchmarks.studies.limits --only nonsense,names -o docs/limits.md     (the others' lines stay)
    python -m benchmarks.studies.limits --only none -o docs/limits.md               (the words alone)

Each input is made in a temporary folder and given to one command in a process of its own. The time is that of the
processor (user and system), the memory the largest resident set. A process is stopped after 120 s of processor time.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.studies import large
from gbspec.data.sheet import LONGEST_LINE, MOST_COLUMNS, MOST_ROWS
from gbspec.exports.programs import MOST_CALLS, MOST_OPERATIONS
from gbspec.imports.safety import DEEPEST, MOST_DECLARED, MOST_ELEMENTS
from gbspec.imports.safety import MOST_BYTES as MOST_XML
from gbspec.ir.schedule import MOST as MOST_SWITCHES
from gbspec.semantics.tables import MOST_POINTS
from gbspec.syntax.limits import (
    LONGEST_WORD,
    MOST_BYTES,
    MOST_ERRORS,
    MOST_PARTS,
    MOST_SIGNS,
    MOST_STATEMENTS,
    MOST_WRITTEN_OUT,
)

MOST_SECONDS, MOST_MEGABYTES, STOP = 5.0, 1000.0, 120
HEAD = "model m\nstate x = 1\nx' = -x\nobserve x\n"


@dataclass(frozen=True)
class Input:
    """A hostile input: what it is, and a function that writes it into a folder and gives the command's arguments."""

    name: str
    what: str
    make: Callable[[Path], list[str]]


def model(text: Callable[[], str]) -> Callable[[Path], list[str]]:
    """`check` of a model."""

    def make(folder: Path) -> list[str]:
        (folder / "m.gb").write_text(text())
        return ["check", str(folder / "m.gb")]

    return make


def table(text: Callable[[], str]) -> Callable[[Path], list[str]]:
    """Reading a table for a model of one state."""

    def make(folder: Path) -> list[str]:
        (folder / "m.gb").write_text(HEAD)
        (folder / "t.csv").write_text(text())
        return ["table", str(folder / "m.gb"), str(folder / "t.csv")]

    return make


def parquet(folder: Path) -> list[str]:
    """A Parquet file of a few kilobytes with 1e8 rows, constant, so that run-length coding packs them."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "m.gb").write_text(HEAD)
    size = 1_000_000
    part = pa.table({name: pa.array([1.0] * size) for name in ("t", "x")})
    with pq.ParquetWriter(folder / "t.parquet", part.schema) as writer:
        for _ in range(100):
            writer.write_table(part, row_group_size=size)
    return ["table", str(folder / "m.gb"), str(folder / "t.parquet")]


def xml(text: Callable[[], str]) -> Callable[[Path], list[str]]:
    """Importing an SBML file."""

    def make(folder: Path) -> list[str]:
        (folder / "m.xml").write_text(text())
        return ["import", str(folder / "m.xml"), "-o", str(folder / "imported")]

    return make


def sbml(body: str) -> str:
    core = 'xmlns="http://www.sbml.org/sbml/level3/version2/core" level="3" version="2"'
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<sbml {core}><model id="m">{body}</model></sbml>'


def pools(count: int) -> str:
    """Parameters, each with a rate rule that needs the one before."""
    each = "".join(f'<parameter id="p{i}" value="1" constant="false"/>' for i in range(count))
    math = '<math xmlns="http://www.w3.org/1998/Math/MathML">'
    rules = "".join(
        f'<rateRule variable="p{i}">{math}<ci>p{max(i - 1, 0)}</ci></math></rateRule>' for i in range(count)
    )
    return sbml(f"<listOfParameters>{each}</listOfParameters><listOfRules>{rules}</listOfRules>")


def entities(levels: int) -> str:
    """Entities of entities: ten to the power of their number, if they were written out."""
    lines = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, levels))
    return f'<?xml version="1.0"?><!DOCTYPE sbml [<!ENTITY e0 "x">{lines}]><sbml>&e{levels - 1};</sbml>'


def lets(count: int) -> str:
    chain = "".join(f"let a{i} = a{i - 1} + 1\n" for i in range(1, count))
    return "model m\nstate x = 1\nlet a0 = 1\n" + chain + f"x' = -x*a{count - 1}\nobserve x\n"


def states(count: int) -> str:
    names = "".join(f"state x{i} = 1\n" for i in range(count))
    chain = "".join(f"x{i}' = x{i - 1} - x{i}\n" for i in range(1, count))
    return f"model m\n{names}x0' = -x0\n{chain}observe x0\n"


INPUTS = (
    Input("nonsense", "a model: 100,000 lines of nonsense", model(lambda: "asdf qwer ?? 17\n" * 100_000)),
    Input("various", "a model: 100,000 different lines of nonsense",
          model(lambda: "".join(f"foo{i} {i} ( bar\n" for i in range(100_000)))),
    Input("names", "a model: 100,000 unknown names",
          model(lambda: HEAD + "".join(f"let a{i} = nothing{i}\n" for i in range(100_000)))),
    Input("sum", "a model: 100,000 unknown names in one sum",
          model(lambda: HEAD + "let a = " + " + ".join(f"nothing{i}" for i in range(100_000)) + "\n")),
    Input("lets", "a model: 25,000 chained `let`", model(lambda: lets(25_000))),
    Input("states", "a model: 25,000 chained states", model(lambda: states(25_000))),
    Input("array", "a model: an array of 1,000,000 states",
          model(lambda: "model m\nstate x[1..1000000] = 1\nx[i]' = -x[i]\nobserve x\n")),
    Input("line", "a model: 10 MB on one line", model(lambda: HEAD + "let a = " + "1 + " * 2_500_000 + "1\n")),
    Input("word", "a model: one name of 10 MB", model(lambda: HEAD + "let " + "a" * 10_000_000 + " = 1\n")),
    Input("number", "a model: one number of 1.5 MB", model(lambda: HEAD + "let a = " + "9" * 1_500_000 + "\n")),
    Input("brackets", "a model: 1,000,000 open brackets", model(lambda: HEAD + "let a = " + "(" * 1_000_000 + "\n")),
    Input("xml-entities", "an SBML file: entities of entities, 1e12 characters", xml(lambda: entities(12))),
    Input("xml-large", "an SBML file: 100 MB", xml(lambda: sbml(" " * 100_000_000))),
    Input("xml-deep", "an SBML file: elements 1,000,000 deep", xml(lambda: "<a>" * 1_000_000)),
    Input("xml-many", "an SBML file: 1,000,000 elements", xml(lambda: sbml("<a/>" * 1_000_000))),
    Input("xml-pools", "an SBML file: 40,000 rate rules in a chain", xml(lambda: pools(40_000))),
    Input("quote", "a model: 100,000 lines in open quotes", model(lambda: 'let a = "b\n' * 100_000)),
    Input("twice", "a model: one state declared 50,000 times", model(lambda: HEAD + "state x = 1\n" * 50_000)),
    Input("indented", "a model: 100,000 indented lines", model(lambda: HEAD + "  let a = 1\n" * 100_000)),
    Input("most-lets", "a model near the limits: 9,900 chained `let`, the last of an unknown name",
          model(lambda: lets(9_900).replace("let a9899 = a9898", "let a9899 = a9898*nothing"))),
    Input("most-states", "a model near the limits: 4,900 chained states, one of an unknown name",
          model(lambda: states(4_900).replace("x4899' = x4898", "x4899' = nothing"))),
    Input("most-names", "a model near the limits: 9,900 unknown names",
          model(lambda: HEAD + "".join(f"let a{i} = nothing{i}\n" for i in range(9_900)))),
    Input("most-sum", "a model near the limits: 70,000 unknown names in one sum",
          model(lambda: HEAD + "let a = " + " + ".join(f"nothing{i}" for i in range(70_000)) + "\n")),
    Input("most-ones", "a model near the limits: a sum of 70,000 numbers, and an unknown name",
          model(lambda: HEAD + "let a = " + "1 + " * 70_000 + "nothing\n")),
    Input("most-lines", "a model near the limits: 20,000 lines of nonsense",
          model(lambda: "asdf qwer ?? 17\n" * 20_000)),
    Input("most-array", "a model near the limits: four arrays of 2,000 states, an unknown name in each balance",
          model(lambda: "model m\n" + "".join(
              f"state {x}[1..2000] = 1\n{x}[i]' = -{x}[i]*nothing\n" for x in "abcd") + "observe a[1]\n")),
    Input("most-parts", "a model near the limits: 2,000 elements, balances of 240 names and numbers, one unknown",
          model(lambda: "model m\nstate x[1..2000] = 1\nx[i]' = " + "-x[i]" * 60 + "*nothing\nobserve x[1]\n")),
    Input("coupled", "a model: 2,000 elements, each balance with the sum of all",
          model(lambda: "model m\nstate x[1..2000] = 1\nx[i]' = -x[i]*sum(x)\nobserve x[1]\n")),
    Input("columns", "a table: 100,000 unknown columns",
          table(lambda: "t,x," + ",".join(f"c{i}" for i in range(100_000)) + ("\n1,1" + ",1" * 100_000) * 3 + "\n")),
    Input("nameless", "a table: 1,000,000 columns without a name",
          table(lambda: "t,x" + "," * 1_000_000 + ("\n1,1" + "," * 1_000_000) * 2 + "\n")),
    Input("same", "a table: 100,000 columns in pairs of one name",
          table(lambda: "t,x," + ",".join(f"c{i // 2}" for i in range(100_000)) + "\n1,1" + ",1" * 100_000 + "\n")),
    Input("cell", "a table: a cell of 50 MB", table(lambda: f"t,x\n0,1\n1,{'a' * 50_000_000}\n")),
    Input("quoted", "a table: a quoted cell of 50 MB", table(lambda: f't,x\n0,1\n1,"{"a b" * 17_000_000}"\n')),
    Input("header", "a table: a column's name of 50 MB", table(lambda: f"t,x,{'a' * 50_000_000}\n0,1,2\n")),
    Input("rows", "a table: 1,000,000 blank rows", table(lambda: "t,x\n" + ",\n" * 1_000_000)),
    Input("words", "a table: 1,000,000 cells that are no numbers",
          table(lambda: "t,x\n" + "".join(f"{i},w{i}\n" for i in range(1_000_000)))),
    Input("parquet", "a table: Parquet, 1e8 constant rows in a small file", parquet),
    Input("trajectories", "a table: 100,000 trajectories",
          table(lambda: "trajectory,t,x\n" + "".join(f"a{i},0,1\na{i},1,2\n" for i in range(100_000)))),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What a command needed, its exit status, and the codes of its diagnostics with the number of each."""

    seconds: float
    megabytes: float
    status: int
    codes: str
    written: int


def run(item: Input) -> Outcome:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arguments = item.make(folder)
        with (folder / "out").open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, *_command(arguments)], stdout=out, stderr=out, preexec_fn=_limited
            )
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        said = (folder / "out").read_text(errors="replace")
    seconds = used.ru_utime + used.ru_stime
    return Outcome(seconds, used.ru_maxrss / 1024, process.returncode, _codes(said), len(said))


READ = """
import sys
from gbspec import frontend
from gbspec.cli.output import Output
from gbspec.diagnostics import Findings, UserError
from gbspec.operations import tables
findings = Findings()
try:
    tables.read_data(sys.argv[2], frontend.load_model(sys.argv[1], findings), findings)
except UserError as error:
    findings.extend(error.diagnostics)
Output().findings(findings)
sys.exit(int(findings.failed))
"""


def _command(arguments: list[str]) -> list[str]:
    """Python's arguments: a command of gbspec, or the reading of a table as every command does it."""
    kind, *files = arguments
    return ["-c", READ, *files] if kind == "table" else ["-m", "gbspec", *arguments]


def _limited() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (STOP, STOP + 1))
    resource.setrlimit(resource.RLIMIT_DATA, (6 * 2**30, 6 * 2**30))


def _codes(said: str) -> str:
    found = re.findall(r"^(?:error|warning)\[(GB\d+)\]", said, re.MULTILINE)
    counts = {code: found.count(code) for code in sorted(set(found))}
    return ", ".join(f"{code} ({count})" if count > 1 else code for code, count in counts.items())


TEXT = f"""# Limits: what is read, and what oversized inputs cost

| limit | at most |
|---|---:|
@LIMITS@

Not offered yet, and said so: groups of a column without a distribution and categories (GB421), in `correlate` (GB434),
and columns that change within a trajectory (GB719); noises with constants of single trajectories (GB425), values of
single trajectories without a distribution beside others with one (GB426), profiles of models with populations (GB777),
censored values under `noise student` (GB785).

A network with an effect among its arguments follows single trajectories where there are few of them: its -2 log
likelihood and AIC say little of new trajectories (docs/studies/populations.md). Nothing warns of that.

Not offered for infusions (`dose … over`): durations and lags that are learned (GB427, GB428), elements of arrays
(GB429), measured rates of the infused state (GB430). A dose in a steady state is preceded by a number of doses, not
by a fixed point: it begins its trajectory (GB749), all initial values are given (GB757), and a table that `simulate
--like` writes of it has the doses before its first row, which a model with `time … from` does not read (GB717).

Not offered together with `diffusion`: populations, noises with learned constants, learned lags of doses, measured
rates of the disturbed state (GB344); censored values (GB784); profiles (GB772); stiff solvers and tolerances
(GB770). `eigen`, `bifurcate` and `export` of such a model take its drift, those of a
population its medians.

Events that set elements of arrays, and events together with `diffusion`, populations or learned noises are not
offered yet (GB351), nor `floor`, `ceil` and `mod` of what changes continuously in their conditions (GB362); nor are
`eigen` and `bifurcate` for such a model (GB778), its export to ONNX (GB808). Its
identifiability is undecided. Second derivatives through the time of an event are not computed. Unknown functions in
conditions, resets and times of events are fitted by the torch graph, much more slowly than by the kernel.

Steps of fits end where right-hand sides switch (`if`, `max`, `min`, `abs`, `sign` of states) only where fixed explicit
steps are taken, and not in models with delays, algebraic variables, disturbances, populations, learned noises, arrays
or steady starts, with more than 16 switches, or where an unknown function, `floor`, `ceil` or `mod` decides:
`--switches on` tells. Solutions that slide along a switch are solved as without.

Algebraic variables that need a search (`equation` without a formula for them): events, disturbances, populations and
learned noises are not offered together with them yet (GB361), nor export to ONNX and `compile --emit c` (GB808); with
unknown functions in the equations fits use torch.
Identifiability is undecided. An index above 1 is refused with the derivative that helps (GB360), not reduced.

Delays of elements of arrays, and delays together with `diffusion`, events, populations and learned noises are not
offered yet (GB372), nor delays of something delayed (GB368) or whose time varies within a trajectory (GB366). Models
with delays have no stiff solvers and no tolerances (GB768), no cycles and no plane of two parameters (GB769), and no
export to SBML and PEtab nor C code by `compile` (GB808). An exported library or unit remembers the steps of its
longest delay, at most 100,000 (GB808). Their identifiability is undecided. No covariance of their Hopf points is
computed. Fits keep the whole solution of a trajectory, and its sensitivities as far back as the longest delay looks. A
learned delay whose lower bound is far below the time between measurements makes fits slow, since no step is longer
than it.

Steady starts (`initial steady`) are not offered with `diffusion`, populations and learned noises, nor with events
whose condition depends on the time, that are `armed` or that wait (GB375), nor where the time itself occurs in a
balance (GB376); such a model is exported to PEtab alone (GB808). Its identifiability is undecided.

Splines (`by spline(12)`) have one or two arguments (GB228), each with a range (GB610), and no curvatures, symmetries,
periods or directions in both arguments (GB607).

[Pairs](studies/pairs.md) has each pair of statements as it was tried.

A larger model gets `GB010`, a larger table `GB732`, a larger export `GB808`, a larger file of an import `GB894`. After
{MOST_ERRORS} wrong statements a file is not read on (`GB011`). The rows of a text are not limited.

Each model below is given to `gbspec check`, each table is read for a model of one state as every command
reads it, in a process of its own:

    python -m benchmarks.studies.limits -o docs/limits.md

Every refusal is to come within {MOST_SECONDS:.0f} s of processor time and {MOST_MEGABYTES:,.0f} MB of memory,
the import of gbspec included. The times are of one machine that other work shares; the tests
(`tests/frontend/test_limits.py`, `tests/data/test_limits.py`) check counts and codes. Without limits
(commit `6e7297e`) the first four models took 38 s, 51 s, more than 119 s with 14.8 GB, and 20 s.

@INPUTS@

## Large tables

`python -m benchmarks.studies.large` measures what is not refused: tables of three columns, read for a model of one
state as every command reads them, and a fit of one constant. A text of more than 100 MB is read where six times its
size is free (GB732), since reading takes five times its size.

@LARGE@
"""
HEADER = """| input | processor time, s | memory, MB | status | diagnostics | text written, kB |
|---|---:|---:|---:|---|---:|
"""
LIMITS = {
    "bytes of a model file": MOST_BYTES,
    "words and signs of a model, with those that it extends": MOST_SIGNS,
    "statements of a model, with those that it extends": MOST_STATEMENTS,
    "statements of a model, one for each element of an array": MOST_WRITTEN_OUT,
    "names, numbers and operations of a model, written out for each element": MOST_PARTS,
    "elements of an array of states": 2_000,
    "characters of a word": LONGEST_WORD,
    "points of a known function (`table`)": MOST_POINTS,
    "times at which right sides jump by themselves, in a trajectory (beyond, steps go across them)": MOST_SWITCHES,
    "columns of a table": MOST_COLUMNS,
    "bytes of a line of a CSV or TSV table": LONGEST_LINE,
    "rows of a Parquet table": MOST_ROWS,
    "operations of an exported function, written out for each element": MOST_OPERATIONS,
    "calls of networks of an exported function": MOST_CALLS,
    "bytes of an XML file that is imported": MOST_XML,
    "elements of an XML file that is imported": MOST_ELEMENTS,
    "quantities and reactions of an SBML file": MOST_DECLARED,
    "depth of the elements of an XML file that is imported": DEEPEST,
}


def row_of(item: Input, found: Outcome) -> str:
    """The line of the page for an input."""
    over = found.seconds > MOST_SECONDS or found.megabytes > MOST_MEGABYTES
    mark = " (**over**)" if over else ""
    return (
        f"| {item.what}{mark} | {found.seconds:.1f} | {found.megabytes:.0f} | {found.status} "
        f"| {found.codes or 'none'} | {found.written / 1000:.0f} |"
    )


def document(rows: dict[str, str]) -> str:
    """The page, with the line of each input that is known by its name."""
    limits = "\n".join(f"| {what} | {most:,} |" for what, most in LIMITS.items())
    inputs = HEADER + "\n".join(rows[item.name] for item in INPUTS if item.name in rows)
    text = TEXT.replace("@LIMITS@", limits).replace("@INPUTS@", inputs)
    return text.replace("@LARGE@", large.table(large.read()))


def kept(page: str) -> dict[str, str]:
    """The lines of inputs that a page has, by their names."""
    lines = page.splitlines()
    found = {}
    for item in INPUTS:
        line = next((one for one in lines if one.startswith((f"| {item.what} |", f"| {item.what} ("))), None)
        if line is not None:
            found[item.name] = line
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="names of inputs, with commas between them")
    parser.add_argument("-o", dest="to", default=None, help="the Markdown file to write")
    options = parser.parse_args()
    wanted = [item for item in INPUTS if not options.only or item.name in options.only.split(",")]
    page = Path(options.to) if options.to else None
    rows = kept(page.read_text()) if page is not None and page.is_file() else {}
    for item in wanted:
        found = run(item)
        rows[item.name] = row_of(item, found)
        print(f"{item.name}: {found}", file=sys.stderr, flush=True)
    text = document(rows)
    if options.to:
        Path(options.to).write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
