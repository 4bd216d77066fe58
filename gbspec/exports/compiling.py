"""Compiles exported C with the system's compiler."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from gbspec.backends import CompilerError, find_compiler

FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden")
TIME_LIMIT = 300.0
"""Seconds after which a compilation is aborted."""


def shared_library(
    folder: Path,
    sources: Mapping[str, str],
    target: Path,
    names: Sequence[str],
    flags: Sequence[str] = FLAGS,
    compiler: str | None = None,
) -> Path:
    """A shared library `target` of the C files `names` among the `sources`, which are written to a folder.

    Raises CompilerError if there is no compiler or it fails.
    """
    compiler = find_compiler() if compiler is None else compiler
    for name, text in sources.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    command = [compiler, *flags, *(str(folder / name) for name in names), "-o", str(target), "-lm"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
    except (subprocess.TimeoutExpired, OSError) as error:
        raise CompilerError(f"{compiler} failed ({error})") from None
    if done.returncode:
        first = next((line for line in done.stderr.splitlines() if "error" in line), f"status {done.returncode}")
        raise CompilerError(f"{compiler} cannot compile the export ({first.strip()})")
    return target
