"""Runs the code blocks of the tutorial, the how-to pages and others, in the order in which a reader meets them.

    python docs/site/blocks.py [PAGE...]

A page is run in an empty folder of its own, with the tables of the tutorial that it names. `gb file=NAME` blocks are
written to that file, `sh` blocks run in a shell that stops at the first failure, `python` blocks in one interpreter for
the page. A block after `<!-- not run: REASON -->` is left out. Exits with 1 if a block fails, when all pages were
tried.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^(<!-- not run: [^\n]*-->\n\n?)?( *)```(\w+)(?: file=(\S+))?\n(.*?)^\2```$", re.S | re.M)


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the file that it is written to if any, its text, and whether it is run."""

    language: str
    file: str
    text: str
    run: bool


def pages() -> list[Path]:
    """The pages whose blocks are run."""
    return [DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]


def blocks(text: str) -> Iterator[Block]:
    """The blocks of a page, in order."""
    for comment, _, language, file, body in BLOCK.findall(text):
        yield Block(language, file, textwrap.dedent(body), not comment)


def run_page(path: Path) -> None:
    """Runs a page's blocks in the current folder; raises SystemExit with the text of one that fails."""
    text = path.read_text(encoding="utf-8")
    for table in (DOCS / "tutorial").glob("*.csv"):
        if table.name in text:
            shutil.copy(table, table.name)
    names: dict[str, Any] = {"__name__": "__main__"}
    sys.path.insert(0, "")  # modules that a page compiles
    for block in blocks(text):
        if block.file:
            Path(block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "sh" and block.run:
            done = subprocess.run(["sh", "-e", "-c", block.text], capture_output=True, text=True)
            if done.returncode:
                raise SystemExit(f"{block.text}\nstatus {done.returncode}\n{done.stdout}{done.stderr}")
        elif block.language == "python" and block.run:
            exec(compile(block.text, path.name, "exec"), names)


def main(arguments: list[str]) -> int:
    """Runs the pages, each in a process of its own; the number of pages that failed, at most 1."""
    if arguments[:1] == ["--page"]:
        run_page(Path(arguments[1]))
        return 0
    # the shell of a block finds the gbspec of this interpreter
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    failed = 0
    for path in [Path(name).resolve() for name in arguments] or pages():
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, str(Path(__file__).resolve()), "--page", str(path)]
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        count = sum(block.run and block.language in ("sh", "python") for block in blocks(path.read_text("utf-8")))
        said = "ok" if done.returncode == 0 else "FAILED"
        print(f"{path.name}: {count} blocks, {time.perf_counter() - began:.0f} s, {said}", flush=True)
        if done.returncode:
            failed = 1
            print(done.stderr or done.stdout, flush=True)
    return failed


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
