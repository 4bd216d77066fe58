"""Every registered backend writes every bundled model or refuses with a reason; a backend is a folder."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import gbspec.backends
from gbspec.backends import Backend, Refusal
from gbspec.backends.module import load_module
from gbspec.backends.registry import backends
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Defect, Findings, UserError
from gbspec.frontend import load_model
from tests.backends.examples import reactor

SCRATCH = """
from gbspec.backends import Backend, Refusal

def make(model, instance, method):
    if not model.complete:
        return Refusal("it has an unknown function", "train it, and compile the run")
    return bytes([0, 255]) + model.name.encode()

BACKEND = Backend("scratch", ".bin", "two bytes and the name", make, binary=True)
"""

COMMAND = """
import sys
import gbspec.backends
gbspec.backends.__path__.append(sys.argv[1])
from gbspec.cli import main
main(sys.argv[2:])
"""


@pytest.mark.parametrize("name", sorted(backends()))
def test_every_bundled_model_can_be_written(name: str) -> None:
    for path in shipped_models().values():
        model = load_model(path, Findings())
        backend = backends()[name]
        cls = load_module(model)
        instance = (cls.random(0) if cls.networks else cls()) if backend.numbers else None
        refused = {"c": model.algebraics or model.delays, "native": model.algebraics}
        if refused.get(name):
            with pytest.raises(UserError, match="GB808"):
                backend.emit(model, instance)
            continue
        made = backend.emit(model, instance)
        assert isinstance(made, bytes) if backend.binary else str(made).endswith("\n")
        assert made == backend.emit(model, instance), "what it writes is reproducible"


def test_numbers_are_required() -> None:
    with pytest.raises(Defect, match="without its numbers"):
        backends()["c"].emit(reactor())


def test_output_has_the_registered_type() -> None:
    with pytest.raises(Defect, match="emits bytes"):
        Backend("b", ".b", "", lambda model, instance, method: b"").emit(reactor())
    with pytest.raises(Defect, match="emits str"):
        Backend("b", ".b", "", lambda model, instance, method: "", binary=True).emit(reactor())


def test_a_refusal_is_a_diagnostic() -> None:
    backend = Backend("b", ".b", "", lambda model, instance, method: Refusal("it has states", "take them out"))
    with pytest.raises(UserError) as caught:
        backend.emit(reactor())
    (finding,) = caught.value.diagnostics
    assert finding.code == "GB808"
    assert "`b` cannot express the model `urp_gb2`: it has states" in finding.message
    assert finding.help == "take them out"


def test_every_folder_is_an_output_form_except_printing_and_casadi() -> None:
    folders = {path.parent.name for path in Path(gbspec.backends.__path__[0]).glob("*/__init__.py")}
    assert folders - set(backends()) == {"casadi", "printing"}
    assert all(backend.suffix.startswith(".") and backend.help for backend in backends().values())


@pytest.fixture
def scratch(tmp_path: Path) -> Iterator[Path]:
    """A folder that is searched in addition to `gbspec/backends`, with a backend that writes bytes."""
    folder = tmp_path / "more" / "scratch"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "backend.py").write_text(SCRATCH)
    (tmp_path / "known.gb").write_text("model known\nstate x = 1\nx' = -x\nobserve x\n")
    (tmp_path / "unknown.gb").write_text("model u\nstate x = 1\nunknown f(x) by mlp(4)\nx' = f(x)\nobserve x\n")
    yield folder.parent
    backends.cache_clear()
    sys.modules.pop("gbspec.backends.scratch.backend", None)


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    run = [sys.executable, "-c", COMMAND, str(folder), *arguments]
    return subprocess.run(run, capture_output=True, text=True, cwd=folder.parent, timeout=120)


def test_adding_a_folder_adds_a_binary_backend_to_the_command(scratch: Path) -> None:
    done = command(scratch, "compile", "known.gb", "--emit", "scratch", "-o", "out.bin", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["emit"] == "scratch"
    assert (scratch.parent / "out.bin").read_bytes() == b"\x00\xffknown"
    assert "scratch: two bytes and the name" in " ".join(
        command(scratch, "compile", "--help").stdout.replace("│", " ").split()
    )
    refused = command(scratch, "compile", "unknown.gb", "--emit", "scratch", "-o", "refused.bin")
    assert refused.returncode == 1
    assert "GB808" in refused.stderr
    assert "it has an unknown function" in refused.stderr
    assert not (scratch.parent / "refused.bin").exists()


def test_and_to_the_python_interface(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gbspec.backends, "__path__", [*gbspec.backends.__path__, str(scratch)])
    backends.cache_clear()
    model = gbspec.load(scratch.parent / "known.gb")
    assert model.compile(scratch.parent / "api.bin", emit="scratch") == b"\x00\xffknown"
    assert (scratch.parent / "api.bin").read_bytes() == b"\x00\xffknown"
    assert str(model.compile(emit="ast")).startswith("ModelStatement 1:1\n")
    with pytest.raises(ValueError, match=r"there is no form `fortran`; there are .*scratch"):
        model.compile(emit="fortran")


def test_a_folder_that_registers_something_else_is_a_defect(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (scratch / "scratch" / "backend.py").write_text("BACKEND = 1\n")
    monkeypatch.setattr(gbspec.backends, "__path__", [str(scratch)])
    backends.cache_clear()
    with pytest.raises(Defect, match="no BACKEND with the name `scratch`"):
        backends()


def test_listing_the_backends_loads_none_of_them() -> None:
    code = "import sys, gbspec.cli.commands.compile; print(sorted({'sympy', 'torch', 'casadi'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
