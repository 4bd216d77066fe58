"""The C code of a model, compiled and compared."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
from pathlib import Path
from typing import Any

import casadi
import numpy as np
import pytest

from gbspec.backends.c import c_code, step
from gbspec.backends.module import load_module
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from tests.backends.examples import clinic, reactor

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_a_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler on this machine")


def compiled(text: str, directory: Path) -> Path:
    (directory / "model.c").write_text(text, encoding="utf-8")
    command = [str(COMPILER), "-std=c99", "-O0", "-shared", "-fPIC", "-Wall", "-Werror", "-Wno-unused-variable"]
    command += ["-Wno-unused-but-set-variable", "-Wno-unused-function", "-o", "model.so", "model.c", "-lm"]
    done = subprocess.run(command, cwd=directory, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return directory / "model.so"


def check(instance: Any, directory: Path) -> None:
    library = str(compiled(c_code(instance), directory))
    generator = np.random.default_rng(0)
    wanted = [instance.casadi_rhs(), instance.casadi_jacobian(), instance.casadi_observe(), step(instance)]
    for function in wanted:
        arguments = [generator.uniform(0.1, 0.9, function.size1_in(i)) for i in range(function.n_in())]
        here = np.array(function(*arguments))
        there = np.array(casadi.external(function.name(), library)(*arguments))
        assert np.all(np.isfinite(here))
        assert there == pytest.approx(here, rel=1e-13, abs=1e-13)


@needs_a_compiler
@pytest.mark.parametrize("model", [reactor, clinic])
def test_networks_in_c(model: Any, tmp_path: Path) -> None:
    check(load_module(model()).random(3), tmp_path)


@needs_a_compiler
def test_a_fit_of_every_bundled_model_in_c(tmp_path: Path) -> None:
    for name, path in sorted(shipped_models().items()):
        model = load_model(path, Findings())
        if model.algebraics or model.delays:  # refused
            continue
        cls = load_module(model)
        (tmp_path / name).mkdir()
        check(cls.random(1) if cls.networks else cls(), tmp_path / name)


def test_the_comment_describes_arguments_and_components() -> None:
    model = dataclasses.replace(clinic(), title="ends */ here")
    text = c_code(load_module(model).random(0))
    comment = text.partition("*/")[0]
    assert "ends * / here" in comment
    assert "rhs(t [1], x [3], condition [0], inputs [1]) -> dx [3]" in comment
    assert "step(t [1], x [3], h [1], condition [0], u0 [1], u1 [1], u2 [1]) -> x_after [3]" in comment
    assert "x: x, state, g" in comment
    assert "g0 = 0.1, lambda = 1.5" in comment


def test_a_step_is_that_of_the_module() -> None:
    instance = load_module(reactor()).random(5)
    found = np.array(step(instance)(0.0, [0.3, 1.2], 0.1, 0.3, [], [], [])).ravel()
    assert found == pytest.approx(instance.step(0.0, [0.3, 1.2], 0.1, 0.3).numpy(), rel=1e-13)
