"""Fixtures of the command tests: the application run in this process, and models."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gbspec.cli.app import build, needed

DECAY = """\
model decay "First-order decay, rate unknown"
state N in [0, 2] = 1
unknown rate(N) by mlp(8, 8)
N' = -rate(N)
observe N
truth rate(N) = 0.7*N
"""

KNOWN = """\
model known "Every form known"
state A in [0, 2] = 1
state B in [0, 2] = 0
learn k = 0.3 in [0, 5]
A' = -k*A
B' = k*A
observe A
observe B
truth k = 0.8
"""


@pytest.fixture
def gbspec() -> Callable[..., Any]:
    """Runs `gbspec ARGUMENTS` in this process; the result has exit_code, stdout, stderr."""

    def run(*arguments: object) -> Any:
        texts = [str(argument) for argument in arguments]
        return CliRunner().invoke(build(needed(texts)), texts)

    return run


@pytest.fixture
def document(gbspec: Callable[..., Any]) -> Callable[..., Any]:
    """Runs `gbspec ARGUMENTS --json` and returns the document; standard output must contain nothing else."""

    def run(*arguments: object) -> Any:
        return json.loads(gbspec(*arguments, "--json").stdout)

    return run


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def decay(here: Path) -> Path:
    """A model with one state and one unknown, which has a truth."""
    path = here / "decay.gb"
    path.write_text(DECAY)
    return path


@pytest.fixture
def known(here: Path) -> Path:
    """A model without unknown functions."""
    path = here / "known.gb"
    path.write_text(KNOWN)
    return path
