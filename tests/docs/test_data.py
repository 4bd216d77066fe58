"""docs/data.md agrees with the behaviour for tables and cases."""

from __future__ import annotations

import re
from pathlib import Path

from gbspec.analysis.simulation import design, simulate
from gbspec.data.cases import load_cases
from gbspec.data.cells import MISSING
from gbspec.data.sheet import SHOWN

TEXT = (Path(__file__).parents[2] / "docs" / "data.md").read_text(encoding="utf-8")


def test_the_example_of_cases_is_read(tmp_path: Path) -> None:
    (example,) = re.findall(r"^```toml\n(.*?)^```$", TEXT, re.S | re.M)
    (tmp_path / "urp_bb.gb").write_text("model urp_bb\n")
    (tmp_path / "cases.toml").write_text(example)
    found = load_cases(tmp_path / "cases.toml")
    case = found.case("B_PUBLISHED")
    assert (case.training.max_step, case.sampling.trajectories, case.metrics.points) == (0.5, 100, 20)


def test_the_words_for_not_measured_are_named() -> None:
    for word in MISSING:
        assert not word or f"`{word}`" in TEXT.lower(), word


def test_the_numbers_named_are_the_ones_used() -> None:
    assert f"checked at {simulate.DENSE} points" in TEXT
    assert f"after {simulate.ATTEMPTS} unsuccessful draws" in TEXT
    assert f"shape {design.SHAPE:g}" in TEXT
    assert "a fifth of the" in TEXT and design.PIECES == 5
    assert "At most five" in TEXT and SHOWN == 5
    assert "1e-10" in TEXT and simulate.TOLERANCE == 1e-10
