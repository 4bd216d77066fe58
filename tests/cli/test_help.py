"""Every command has help, with examples that its parser accepts."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from typing import Any

import pytest

from gbspec.cli.app import COMMANDS
from gbspec.cli.flags import flagged
from gbspec.cli.groups import GROUPS
from gbspec.data.sampling import SimulateOptions
from gbspec.studies.options import StudyOptions
from gbspec.training.options import TrainOptions
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


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_words_for_values_and_no_types_of_python(gbspec: Callable[..., Any], name: str) -> None:
    shown = gbspec(name, "--help").stdout
    assert not re.findall(r"<(bool|str|int|float|list)\b", shown)


@pytest.mark.parametrize("options", [TrainOptions, SimulateOptions, StudyOptions])
def test_every_option_of_a_large_command_has_its_group(options: type) -> None:
    grouped = [name for names in GROUPS[options.__name__].values() for name in names]
    assert sorted(grouped) == sorted(field.name for field in flagged(options))


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
