"""`bifurcate --members all`: every member drawn, an interval for each Hopf point; where what was trained ends."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gbspec import driver
from gbspec.cli.app import build
from gbspec.report import diagram as figures
from tests.analysis.conftest import model_of, nearly_true


def call(*arguments: object) -> Any:
    return CliRunner().invoke(build(("bifurcate",)), ["bifurcate", *map(str, arguments)])


def test_every_member_is_drawn_and_gives_an_interval(
    write_run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_run(model_of("urp_gb2"), *(nearly_true({"B": B}) for B in (11.0, 11.1)))
    drawn: list[int] = []
    plain = figures.diagram
    monkeypatch.setattr(
        figures, "diagram", lambda shown, others, truth: drawn.append(1 + len(others)) or plain(shown, others, truth)
    )
    monkeypatch.setattr(driver, "true_diagram", lambda *asked, cycles: None)
    asked = (run.path, "--over", "Da", "--range", 0.15, 0.3, "--json")
    result = call(*asked, "--members", "all", "-o", tmp_path / "members.svg")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert drawn == [2]
    (point,) = found["special"]
    low, high = point["interval"]
    # A larger heat of reaction oscillates earlier: by half a percent in Da for one percent in B.
    assert point["type"] == "hopf"
    assert point["value"] == high
    assert 1e-3 < high - low < 1e-2
    # What was trained is said, and where a branch leaves it.
    assert found["trained"] == [0.2, 0.5]
    for branch in found["branches"]:
        for place in branch["points"]:
            assert ("Da" in place["outside"]) is (place["value"] < 0.2 - 1e-6)
