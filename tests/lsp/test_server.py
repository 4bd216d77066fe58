"""The server after a failure of a handler, and without the package that it needs."""

from __future__ import annotations

import logging
import subprocess
import sys

import pytest
from pygls.exceptions import JsonRpcException

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.lsp.references import Refused
from gbspec.lsp.server import REQUEST_FAILED, guarded


def test_a_failure_in_a_handler_is_logged_and_answered_with_nothing(caplog: pytest.LogCaptureFixture) -> None:
    @guarded
    def handler(number: int) -> float:
        return 1 / number

    assert handler(2) == 0.5
    with caplog.at_level(logging.ERROR):
        assert handler(0) is None
    assert "handler failed" in caplog.text
    assert "ZeroDivisionError" in caplog.text


def test_a_mistake_in_a_text_is_no_failure(caplog: pytest.LogCaptureFixture) -> None:
    @guarded
    def handler() -> None:
        raise UserError([Diagnostic("GB001", "there is no file", None)])

    with caplog.at_level(logging.WARNING):
        assert handler() is None
    assert not caplog.text


def test_a_refusal_reaches_the_person_with_its_reason() -> None:
    @guarded
    def handler() -> None:
        raise Refused("`x` is declared already")

    with pytest.raises(JsonRpcException, match="declared already") as caught:
        handler()
    assert caught.value.code == REQUEST_FAILED


def test_without_its_package_the_command_says_what_to_install() -> None:
    hidden = "import sys; sys.modules['pygls'] = None; from gbspec.cli import main; main(['lsp'])"
    done = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 2
    assert "pip install pygls" in done.stderr
