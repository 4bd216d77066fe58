"""Mutated files: every one gives a model or findings, never a traceback, and never takes long.

A campaign: `python -m tests.fuzz --count 100000 --workers 2`; a short one runs in tests/syntax/test_fuzz.py. A file
that fails is written to `--keep` (default: `fuzz_failures/`), with the traceback beside it.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import FrameType

from gbspec.diagnostics import Findings, Source, UserError
from gbspec.diagnostics.render import render_text, to_json

ROOT = Path(__file__).parents[1]
SECONDS = 20.0  # of processor time, so that a busy machine is no failure
ODD = "\x00\t\r\u00a0\u200b\ufeffμа·−×²“”’√🎉\u0301\u202e\ud7ff#\"'()[]{}=<>!&|;:,.^*/+-0123456789eE_ \n"
TOKENS = (
    *(
        "state",
        "let",
        "unknown",
        "process",
        "observe",
        "initial",
        "learn",
        "const",
        "in",
        "by",
        "rate",
        "zero at",
        "nn",
    ),
    *(
        "->",
        "..",
        "**",
        "==",
        ">=",
        "<=",
        "'",
        "''",
        ":=",
        "&&",
        "||",
        "//",
        "1e999",
        "1e-400",
        "0",
        "pi",
        "if(",
        "net(",
    ),
    *(
        "extends",
        '"',
        "\n",
        "\n  ",
        "\n)",
        "# ",
        "((((((",
        "))))",
        "[[",
        "sum(",
        "c[i]",
        "x^x^x^x",
        "----",
        "not ",
        "and",
    ),
)


def corpus() -> list[str]:
    """The texts that are mutated: wrong files, and about as many right ones (bundled models, every statement)."""
    right = sorted([*ROOT.glob("models/**/*.gb"), *ROOT.glob("tests/syntax/*.gb")])
    wrong = sorted(ROOT.glob("tests/bad/*/*.gb"))
    files = wrong + right * max(1, len(wrong) // len(right))
    return [path.read_text(encoding="utf-8") for path in files]


# -------------------------------------------------------------------------------------------------------- mutations


def _spot(text: str, random: random.Random) -> int:
    return random.randint(0, len(text))


def delete(text: str, random: random.Random) -> str:
    at = _spot(text, random)
    return text[:at] + text[at + random.choice((1, 1, 2, 5, 30)) :]


def insert_character(text: str, random: random.Random) -> str:
    at = _spot(text, random)
    return text[:at] + random.choice(ODD) * random.choice((1, 1, 1, 3)) + text[at:]


def insert_token(text: str, random: random.Random) -> str:
    at = _spot(text, random)
    return text[:at] + random.choice(("", " ")) + random.choice(TOKENS) + random.choice(("", " ")) + text[at:]


def duplicate(text: str, random: random.Random) -> str:
    at, to = sorted((_spot(text, random), _spot(text, random)))
    return text[:to] + text[at:to][:200] + text[to:]


def swap_lines(text: str, random: random.Random) -> str:
    lines = text.split("\n")
    a, b = random.randrange(len(lines)), random.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return "\n".join(lines)


def delete_line(text: str, random: random.Random) -> str:
    lines = text.split("\n")
    del lines[random.randrange(len(lines))]
    return "\n".join(lines)


def indent_line(text: str, random: random.Random) -> str:
    lines = text.split("\n")
    at = random.randrange(len(lines))
    lines[at] = random.choice((" ", "\t", "    ")) + lines[at] if random.random() < 0.5 else lines[at].lstrip()
    return "\n".join(lines)


def swap_words(text: str, random: random.Random) -> str:
    words = text.split(" ")
    a, b = random.randrange(len(words)), random.randrange(len(words))
    words[a], words[b] = words[b], words[a]
    return " ".join(words)


def truncate(text: str, random: random.Random) -> str:
    return text[: _spot(text, random)]


def nest(text: str, random: random.Random) -> str:
    at = _spot(text, random)
    depth = random.choice((3, 90, 101, 2000))
    return text[:at] + random.choice("([-") * depth + text[at:]


def lengthen(text: str, random: random.Random) -> str:
    at = _spot(text, random)
    return (
        text[:at]
        + random.choice((" + x", "*x", "^2", ", x", " and x > 1", "(x)")) * random.choice((10, 300))
        + text[at:]
    )


MUTATIONS: tuple[Callable[[str, random.Random], str], ...] = (
    *(delete, insert_character, insert_token, insert_token, duplicate, swap_lines, delete_line, indent_line),
    *(swap_words, truncate, nest, lengthen),
)


def mutated(seeds: list[str], number: int) -> str:
    """The file of a number: a text of the corpus, or the halves of two, with one to four mutations."""
    chance = random.Random(number)
    text = chance.choice(seeds)
    if chance.random() < 0.1:
        other = chance.choice(seeds)
        text = text[: _spot(text, chance)] + other[_spot(other, chance) :]
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        text = chance.choice(MUTATIONS)(text, chance)
    return text


# ------------------------------------------------------------------------------------------------------- what is run


@dataclass(frozen=True)
class Outcome:
    """What came of one file: `model`, `findings`, or the traceback of a failure."""

    kind: str
    detail: str = ""


def front_end(text: str) -> str:
    """Does all that `gbspec check` does up to the Model, formats the text, and renders what is found."""
    from gbspec.frontend import load_model, read_source
    from gbspec.syntax.formatter import format_text

    source = Source(str(ROOT / "models" / "bf" / "mutated.gb"), text)
    findings = Findings()
    kind = "findings"
    try:
        load_model(source.path, findings, lambda path: source if str(path) == source.path else read_source(path))
        kind = "model"
    except UserError as error:
        findings.extend(error.diagnostics)
        if not findings.failed:
            raise AssertionError("neither a model nor an error") from error
    try:
        format_text(source)
    except UserError as error:
        if kind == "model":
            raise AssertionError("a model that cannot be formatted") from error
    render_text(findings)
    for finding in findings:
        to_json(finding)
    return kind


def outcome(text: str) -> Outcome:
    """Runs the front end on a text under the time limit."""

    def too_long(signal_number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"more than {SECONDS:g} seconds")

    previous = signal.signal(signal.SIGPROF, too_long)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        return Outcome(front_end(text))
    except Exception:  # whatever it is, the campaign reports it and goes on
        return Outcome("failure", traceback.format_exc())
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, previous)


def _run(numbers: list[int]) -> list[tuple[int, Outcome, float]]:
    seeds = corpus()
    results = []
    for number in numbers:
        begin = time.monotonic()
        found = outcome(mutated(seeds, number))
        results.append((number, found, time.monotonic() - begin))
    return results


def campaign(count: int, first: int, workers: int) -> Iterator[tuple[int, Outcome, float]]:
    """The outcomes of the files `first` to `first + count - 1`."""
    numbers = iter(range(first, first + count))
    batches = iter(lambda: list(islice(numbers, 50)), [])
    if workers == 1:
        for batch in batches:
            yield from _run(batch)
        return
    with ProcessPoolExecutor(workers) as pool:
        for results in pool.map(_run, batches):
            yield from results


def main() -> int:
    """Runs a campaign from the command line; status 1 if a file failed."""
    parser = argparse.ArgumentParser(description="Mutated files through the whole front end.")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first file; a number always gives the same file"
    )
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", type=Path, default=Path("fuzz_failures"))
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    slowest = (0.0, -1)
    for number, found, seconds in campaign(options.count, options.first, options.workers):
        counts[found.kind] += 1
        slowest = max(slowest, (seconds, number))
        if found.kind == "failure":
            options.keep.mkdir(exist_ok=True)
            (options.keep / f"{number}.gb").write_text(mutated(corpus(), number), encoding="utf-8")
            (options.keep / f"{number}.txt").write_text(found.detail, encoding="utf-8")
            print(number, found.detail.strip().splitlines()[-1], flush=True)
    print(f"{options.count} files: {dict(counts)}; the slowest, {slowest[1]}, took {slowest[0]:.2f} s")
    return 1 if counts["failure"] else 0


if __name__ == "__main__":
    sys.exit(main())
