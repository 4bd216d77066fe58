"""Every registered backend writes every shipped model; the command offers exactly those."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from gbspec.backends.module import load_module
from gbspec.backends.registry import BACKENDS
from gbspec.cli.commands.compile import Form
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Defect, Findings
from gbspec.driver import load_model
from tests.backends.examples import reactor


def test_the_command_offers_every_backend() -> None:
    assert get_args(Form) == tuple(BACKENDS)
    assert all(BACKENDS[name].name == name and BACKENDS[name].suffix.startswith(".") for name in BACKENDS)


@pytest.mark.parametrize("name", sorted(BACKENDS))
def test_every_shipped_model_can_be_written(name: str) -> None:
    for path in shipped_models().values():
        model = load_model(path, Findings())
        backend = BACKENDS[name]
        cls = load_module(model)
        instance = (cls.random(0) if cls.networks else cls()) if backend.numbers else None
        text = backend.emit(model, instance)
        assert text.endswith("\n")
        assert text == backend.emit(model, instance), "the text is reproducible"


def test_numbers_are_asked_for() -> None:
    with pytest.raises(Defect, match="without its numbers"):
        BACKENDS["c"].emit(reactor())


def test_no_backend_is_left_out_of_the_registry() -> None:
    """One folder each: those that write text are registered, `casadi` writes C, `native` is compiled while training,
    `printing` is what they share."""
    folders = {path.parent.name for path in (Path(load_module.__code__.co_filename).parents[1]).glob("*/__init__.py")}
    assert folders == {"casadi", "latex", "module", "native", "printing"}
