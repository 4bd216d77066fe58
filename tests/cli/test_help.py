"""Every command has help, with examples that its parser accepts."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from typing import Any

import pytest

from gbspec.cli.app import COMMANDS
from gbspec.version import __version__

from .command_lines import accepted, load

EXAMPLES = [(name, example) for name in COMMANDS for example in load(name).examples]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example_and_the_common_flags(gbspec: Callable[..., Any], name: str) -> None:
    result = gbspec(name, "--help")
    assert result.exit_code == 0
    assert "Example" in result.stdout
    assert f"gbspec {name}" in result.stdout.replace("\n", " ")
    assert "--quiet" in result.stdout
    assert "--json" in result.stdout


@pytest.mark.parametrize(("name", "example"), EXAMPLES)
def test_every_example_parses(name: str, example: str) -> None:
    assert shlex.split(example)[:2] == ["gbspec", name]
    assert accepted(example)


def test_the_group_lists_every_command(gbspec: Callable[..., Any]) -> None:
    shown = gbspec("--help").stdout
    assert all(f" {name} " in shown for name in COMMANDS)


def test_version(gbspec: Callable[..., Any]) -> None:
    assert gbspec("--version").stdout.strip() == f"gbspec {__version__}"


def test_a_misspelt_command_is_usage_and_gets_a_suggestion(gbspec: Callable[..., Any]) -> None:
    result = gbspec("chekc")
    assert result.exit_code == 2
    assert "check" in result.stderr
