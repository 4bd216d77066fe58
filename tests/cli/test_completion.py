"""The scripts of `gbspec completion`: their words, and what bash, zsh and fish (where installed) make of them."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gbspec.cli.app import COMMANDS
from gbspec.data.shipped import shipped_models

BASH = """
source ./script
COMP_WORDS=({line}) COMP_CWORD={place}
_gbspec
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_script_has_every_command_and_the_shell_can_read_it(
    gbspec: Callable[..., Any], here: Path, shell: str
) -> None:
    text = gbspec("completion", shell).stdout
    assert all(name in text for name in (*COMMANDS, *shipped_models()))
    (here / "script").write_text(text)
    if shutil.which(shell):
        done = subprocess.run([shell, "-n", "script"], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not shutil.which("bash"), reason="there is no bash")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("gbspec tr", ["train"]),
        ("gbspec train --eff", ["--effort"]),
        ("gbspec train a.gb --effort ''", ["low", "normal", "high"]),
        ("gbspec train --no-", ["--no-warm-start", "--no-half-step"]),
        ("gbspec check urp_gb", ["urp_gb1", "urp_gb2"]),
        ("gbspec completion z", ["zsh"]),
        ("gbspec plot my_run param", []),
        ("gbspec train a.gb data.csv -o ''", []),
        ("gbspec explain ''", []),
    ],
)
def test_what_bash_completes(gbspec: Callable[..., Any], here: Path, line: str, expected: list[str]) -> None:
    (here / "script").write_text(gbspec("completion", "bash").stdout)
    asked = BASH.format(line=line, place=len(line.split()) - 1)
    done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.split() == expected


def test_another_shell_is_wrong_usage(gbspec: Callable[..., Any]) -> None:
    assert gbspec("completion", "tcsh").exit_code == 2
