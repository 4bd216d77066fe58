"""The frame: exit statuses, no tracebacks, one JSON document."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
import typer
from typer.testing import CliRunner

from gbspec.cli.frame import Command, command, file_trouble, guarded
from gbspec.cli.output import Output, jsonable
from gbspec.diagnostics import ComputationError, Defect, Diagnostic, UserError
from gbspec.report.text import number, table


def raising(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (UserError([Diagnostic("GB801", "`a.gb` does not exist", None)]), 1, "GB801"),
        (ComputationError("it blew up", where="trajectory 3", remedy="a smaller step"), 3, "try: a smaller step"),
        (Defect("the verifier found a cycle"), 70, "defect of gbspec"),
        (ZeroDivisionError("division by zero"), 70, "ZeroDivisionError"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (FileNotFoundError(errno.ENOENT, "no such file", "x.csv"), 1, "GB801"),
        (PermissionError(errno.EACCES, "denied", "x.csv"), 1, "GB805"),
        (OSError(errno.ENOSPC, "No space left on device", "x.csv"), 1, "no space left"),
        (MemoryError(), 3, "memory"),
        (OSError(errno.EINVAL, "it is a pipe", os.devnull), 1, "not a file"),
    ],
)
def test_every_outcome_has_its_exit_status(
    error: BaseException, status: int, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Any, monkeypatch: Any
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert guarded(raising(error), Output()) == status
    shown = capsys.readouterr()
    assert said in shown.err
    assert "Traceback" not in shown.err
    assert shown.out == ""


def test_the_details_of_a_defect_are_written_to_a_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    guarded(raising(KeyError("lost")), Output())
    (log,) = tmp_path.glob("gbspec-defect-*.log")
    assert "Traceback" in log.read_text()
    assert str(log) in capsys.readouterr().err


def test_a_traceback_is_shown_on_request(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GBSPEC_TRACEBACK", "1")
    assert guarded(raising(KeyError("lost")), Output()) == 70
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("error", [UserError([Diagnostic("GB801", "gone", None)]), ComputationError("no"), KeyError(1)])
def test_with_json_a_failure_is_one_document_too(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    guarded(raising(error), Output(json=True))
    assert set(json.loads(capsys.readouterr().out)) <= {"diagnostics", "error", "defect"}


def test_an_operating_system_error_of_another_kind_is_not_the_users_fault() -> None:
    assert file_trouble(OSError(errno.EINVAL, "invalid argument")) is None


@dataclass(frozen=True)
class Options:
    dt: float = field(default=0.5, metadata={"help": "mean interval"})
    sampling: Literal["regular", "gamma"] = "regular"
    keep_start: bool = False
    epochs: int | None = None
    boxes: dict[str, str] = field(
        default_factory=dict, metadata={"flag": "--box", "parse": lambda given: dict(item.split("=") for item in given)}
    )
    hidden: int = field(default=3, metadata={"cli": False})

    def __post_init__(self) -> None:
        if self.dt <= 0:
            raise UserError([Diagnostic("GB814", "`--dt` is above 0", None)])


@command("sample", "sample a --dt 1")
def sample(output: Output, name: str, options: Options) -> None:
    """Sample."""
    output.document({"name": name, "options": options})
    output.result(f"{name} {options.dt}")


def invoke(made: Command, *arguments: str) -> Any:
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command(made.name, help=made.help, epilog=made.epilog)(made.call)
    return CliRunner().invoke(app, list(arguments))


def test_options_come_from_the_dataclass() -> None:
    result = invoke(
        sample, "a", "--dt", "2", "--sampling", "gamma", "--keep-start", "--box", "x=1:2", "--box", "y=3", "--json"
    )
    assert result.exit_code == 0, result.output
    options = json.loads(result.stdout)["options"]
    expected = {"dt": 2.0, "sampling": "gamma", "keep_start": True, "epochs": None, "hidden": 3}
    assert options == {**expected, "boxes": {"x": "1:2", "y": "3"}}


def test_defaults_are_the_dataclass_defaults() -> None:
    result = invoke(sample, "a", "--json")
    assert json.loads(result.stdout)["options"] == jsonable(Options())


def test_a_field_without_a_flag_has_none() -> None:
    assert invoke(sample, "a", "--hidden", "4").exit_code == 2


@pytest.mark.parametrize("bad", [["--dt", "soon"], ["--sampling", "often"], ["--nonsense"], []])
def test_usage_errors_exit_2(bad: list[str]) -> None:
    assert invoke(sample, *(["a", *bad] if bad else [])).exit_code == 2


@pytest.mark.parametrize(
    ("codes", "status"),
    [(("GB009",), 2), (("GB812",), 2), (("GB850", "GB201"), 2), (("GB001",), 1), (("GB804",), 1), (("GB854",), 1)],
)
def test_a_name_that_no_file_could_make_right_is_wrong_usage(codes: tuple[str, ...], status: int) -> None:
    assert guarded(raising(UserError([Diagnostic(code, "wrong", None) for code in codes])), Output()) == status


def test_a_wrong_choice_is_told_in_words_with_a_suggestion() -> None:
    result = invoke(sample, "a", "--sampling", "gama")
    assert result.exit_code == 2
    said = " ".join(result.stderr.replace("│", " ").split())
    assert "'gama' is not one of regular, gamma. Did you mean 'gamma'?" in said
    assert "Value error" not in result.stderr


def test_an_invalid_option_value_is_a_diagnostic() -> None:
    result = invoke(sample, "a", "--dt", "0")
    assert result.exit_code == 2
    assert "GB814" in result.stderr


def test_json_has_no_nan_and_keeps_every_digit() -> None:
    import numpy as np

    values = {"a": np.array([0.1, np.nan]), "b": float("inf"), "c": np.float64(1 / 3), "d": (1, True, None)}
    assert jsonable(values) == {"a": [0.1, None], "b": None, "c": 1 / 3, "d": [1, True, None]}
    with pytest.raises(TypeError, match="object"):
        jsonable(object())


def test_quiet_keeps_results_and_errors(capsys: pytest.CaptureFixture[str]) -> None:
    output = Output(quiet=True)
    output.say("working")
    output.summary("summary")
    output.result("result")
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("result\n", "")


def test_numbers_and_tables_are_aligned() -> None:
    assert [number(v) for v in (0.0, None, 1.23456, 1.2e-7, 123456.0, float("nan"))] == [
        *("0", "-", "1.235", "1.20e-07", "1.23e+05", "-"),
    ]
    shown = table(("name", "value"), [("a", "1"), ("long name", "12.5")])
    assert shown.splitlines() == ["name       value", "---------  -----", "a              1", "long name   12.5"]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no pipes that a reader closes like this")
def test_what_could_not_be_told_is_no_success(tmp_path: Path) -> None:
    code = "import sys; from gbspec.cli.frame import guarded; from gbspec.cli.output import Output\n"
    code += "sys.exit(guarded(lambda: [print('x' * 70000, flush=True) for _ in range(9)], Output()))"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.read(1) == b"x"
    process.stdout.close()
    assert process.stderr is not None and process.stderr.read() == b""
    assert process.wait() == 141
