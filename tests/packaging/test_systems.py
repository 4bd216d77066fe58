"""What a system lacks is done without: signals, users and groups, compilers, paths between drives."""

from __future__ import annotations

import ast
import os
import signal
import sys
import threading
import tomllib
from pathlib import Path

import pytest

from gbspec.backends.native import compiler
from gbspec.cli.commands.demo import typed
from gbspec.files import read_bytes, write_text
from gbspec.training.runs import signals

ROOT = Path(__file__).parents[2]


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A system without the signals, the masks, and the functions on users and folders that POSIX has."""
    for name in ("SIGHUP", "pthread_sigmask"):
        monkeypatch.delattr(signal, name, raising=False)
    for name in ("geteuid", "getuid", "O_DIRECTORY", "O_NONBLOCK", "fork"):
        monkeypatch.delattr(os, name, raising=False)


def test_requests_to_end_are_noted_with_the_signals_there_are(windows: None) -> None:
    assert signal.SIGINT in signals._signals()
    with signals.held_back(), signals.uninterrupted() as asked:
        assert not asked()
        signal.raise_signal(signal.SIGTERM)
        assert asked()


def test_no_tracker_is_started_where_there_is_none(windows: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def ensure_running() -> None:
        raise AssertionError("it cannot be started here")

    monkeypatch.setattr(signals.resource_tracker, "ensure_running", ensure_running)
    signals.start_tracker()


def test_a_study_in_a_thread_leaves_signals_alone() -> None:
    from gbspec.studies.runner import _terminable

    errors: list[BaseException] = []

    def work() -> None:
        try:
            with _terminable():
                pass
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not errors


def test_files_are_written_and_trusted(windows: None, tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "text")
    assert read_bytes(path) == b"text"
    assert compiler.trusted(path)
    assert not compiler.trusted(tmp_path / "absent.so")


def test_a_folder_that_cannot_be_opened_is_still_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, flags: int) -> int:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(IsADirectoryError):
        read_bytes(tmp_path)
    with pytest.raises(PermissionError):
        read_bytes(tmp_path / "absent")


@pytest.mark.parametrize(
    ("platform", "place"), [("win32", ("gbspec", "Cache")), ("darwin", ("Caches", "gbspec")), ("linux", ("gbspec",))]
)
def test_kernels_are_kept_where_the_system_keeps_them(
    platform: str, place: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.delenv("GBSPEC_CACHE", raising=False)
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    assert compiler.cache_directory().parts[-len(place) :] == place


def test_a_program_on_another_drive_is_named_in_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def other_drive(path: Path) -> str:
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    program = tmp_path / "gbspec"
    program.write_text("")
    monkeypatch.setattr("gbspec.cli.commands.demo.shutil.which", lambda name: None)
    monkeypatch.setattr(os.path, "relpath", other_drive)
    assert typed(str(program)) == str(program)


def test_modules_that_only_some_systems_have_are_not_imported_at_once() -> None:
    """`fcntl`, `grp` and the like are imported inside of functions that ask for the system first."""
    some = {"fcntl", "grp", "pwd", "resource", "termios", "msvcrt", "winreg", "posix", "_posixsubprocess"}
    found = []
    for path in (ROOT / "gbspec").rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found += [f"{path.name}: {name}" for name in names if name in some]
    assert not found


def test_no_process_is_forked() -> None:
    """A fork of a process with threads may hang, and Windows has none: processes are always spawned."""
    for path in (ROOT / "gbspec").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert "os.fork" not in text
        assert 'get_context("fork' not in text
        assert "ProcessPoolExecutor(workers)" not in text


def test_the_workflow_has_the_systems_and_versions_that_are_promised() -> None:
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    for system in ("ubuntu-latest", "macos-latest", "windows-latest"):
        assert system in text
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions = [name.rpartition(" ")[2] for name in project["classifiers"] if "Python :: 3." in name]
    assert versions == ["3.11", "3.12", "3.13"]
    assert all(f'"{version}"' in text for version in versions)
