"""The model-dependent part of the text of generated modules. `UPDATE_GOLDEN=1 pytest ...` regenerates it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import gbspec
from gbspec.backends.module import generate
from gbspec.ir.model import Model
from tests.backends.examples import clinic, reactor

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.mark.parametrize("model", [reactor, clinic])
def test_generated_text(model: Callable[[], Model]) -> None:
    text = generate(model())
    head, rule, _ = text.partition("    # ------------------------------------------------------------------ weights\n")
    assert rule, "the part that is the same for all models has moved"
    path = GOLDEN / f"module_{model().name}.py.txt"
    if os.environ.get("UPDATE_GOLDEN"):
        path.write_text(head, encoding="utf-8")
    assert head == path.read_text(encoding="utf-8")


def test_the_text_does_not_depend_on_hashing() -> None:
    imports = "import gbspec; from tests.backends.examples import clinic; from gbspec.backends.module import generate"
    command = f"{imports}; print(generate(clinic())); print(generate(gbspec.load('spreading_population').model))"
    texts = {f"{generate(clinic())}\n{generate(gbspec.load('spreading_population').model)}\n"} | {
        subprocess.run(
            [sys.executable, "-c", command],
            env={**os.environ, "PYTHONHASHSEED": seed},
            cwd=GOLDEN.parents[1],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(texts) == 1
